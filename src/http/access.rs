//! What every matched route asks of a request: that its caller may use it, and that its query names parameters
//! of the operation only.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use axum::extract::{FromRequestParts, MatchedPath, Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use hyper::http::request::Parts;
use hyper::{Method, Uri};
use utoipa::openapi::path::ParameterIn;
use utoipa::openapi::{OpenApi, RefOr};

use super::Rest;
use super::body::discard;
use super::extract::Params;
use super::problem::{ApiError, ApiResult};
use crate::app::App;
use crate::app::access::{Caller, Permission};
use crate::domain::{Error, Result};

/// The query parameters of the operations, as the description names them.
pub(super) struct QueryParameters(HashMap<(String, String), HashSet<String>>);

impl QueryParameters {
    pub(super) fn of(description: &OpenApi) -> Self {
        let mut parameters = HashMap::new();
        for (template, item) in &description.paths.paths {
            let operations = [
                ("GET", &item.get),
                ("POST", &item.post),
                ("PUT", &item.put),
                ("PATCH", &item.patch),
                ("DELETE", &item.delete),
            ];
            for (method, operation) in operations {
                let Some(operation) = operation else { continue };
                let names = operation.parameters.iter().flatten().filter_map(|parameter| match parameter {
                    RefOr::T(parameter) if parameter.parameter_in == ParameterIn::Query => {
                        Some(parameter.name.clone())
                    }
                    _ => None,
                });
                parameters.insert((template.clone(), method.to_owned()), names.collect());
            }
        }
        Self(parameters)
    }

    /// A method that the route does not have is left to the router to refuse.
    ///
    /// # Errors
    /// `InvalidArgument` naming a parameter that the operation does not have.
    fn check(&self, template: &str, method: &Method, uri: &Uri) -> Result<()> {
        if uri.query().is_none_or(str::is_empty) {
            return Ok(());
        }
        // The router answers HEAD by the handler of GET.
        let method = if method == Method::HEAD { &Method::GET } else { method };
        match self.0.get(&(template.to_owned(), method.to_string())) {
            Some(known) => Params::of(uri)?.check_names(|name| known.contains(name)),
            None => Ok(()),
        }
    }
}

/// Refuses a request before its handler runs, if the caller may not use the matched route, or the query has
/// what the operation does not know.
pub(super) async fn authorize(
    State(parameters): State<Arc<QueryParameters>>,
    request: Request,
    next: Next,
) -> Response {
    let template = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str);
    let permission = Permission::of_route(request.method().as_str(), template);
    let authorized = match request.extensions().get::<Caller>() {
        Some(caller) => caller.authorize(permission),
        None => Err(no_caller()),
    };
    let checked = authorized.and_then(|()| parameters.check(template, request.method(), request.uri()));
    match checked {
        Ok(()) => next.run(request).await,
        Err(error) => {
            let (head, mut body) = request.into_parts();
            discard(&head.headers, &mut body).await;
            ApiError::from(error).into_response()
        }
    }
}

/// The application on behalf of the request's caller.
pub(super) struct CallerApp(pub(super) App);

impl FromRequestParts<Rest> for CallerApp {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, rest: &Rest) -> ApiResult<Self> {
        let caller = parts.extensions.get::<Caller>().ok_or_else(no_caller)?;
        Ok(Self(rest.app.on_behalf_of(caller.clone())))
    }
}

fn no_caller() -> Error {
    Error::fault("a request came without its caller")
}
