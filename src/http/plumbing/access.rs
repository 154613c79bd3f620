//! The checks of every matched route: its caller may use it, and its query names parameters
//! of the operation only.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::task::{Context, Poll};

use axum::extract::{FromRequestParts, MatchedPath, Request};
use axum::response::{IntoResponse as _, Response};
use futures_util::future::{Either, Ready, ready};
use hyper::http::request::Parts;
use hyper::{Method, Uri};
use tower::{Layer, Service};
use utoipa::openapi::path::ParameterIn;
use utoipa::openapi::{OpenApi, RefOr};

use super::body_coding::decoded;
use super::extract::Params;
use super::problem::{ApiError, ApiResult};
use crate::app::App;
use crate::app::access::Permission;
use crate::domain::Result;
use crate::http::plumbing::state::Rest;
use crate::operations::RoutePermission;
use crate::request::RequestContext;
use crate::telemetry::Route;

/// The query parameters of the operations, as the description names them. Missing are operations that take any: those
/// with a parameter that is exploded.
struct QueryParameters(HashMap<(String, String), HashSet<String>>);

impl QueryParameters {
    fn of(description: &OpenApi) -> Self {
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
                let known = operation.parameters.iter().flatten().filter_map(|parameter| match parameter {
                    RefOr::T(parameter) if parameter.parameter_in == ParameterIn::Query => Some(parameter),
                    _ => None,
                });
                let known: Vec<_> = known.collect();
                if known.iter().all(|parameter| parameter.explode.is_none()) {
                    let names = known.into_iter().map(|parameter| parameter.name.clone()).collect();
                    parameters.insert((template.clone(), method.to_owned()), names);
                }
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
/// what the operation does not know. Only the body of a request that is let through is decoded.
#[derive(Clone)]
pub(in crate::http) struct AuthorizeLayer(Arc<QueryParameters>);

impl AuthorizeLayer {
    /// For the routes of a description.
    pub(in crate::http) fn of(description: &OpenApi) -> Self {
        Self(Arc::new(QueryParameters::of(description)))
    }
}

impl<S> Layer<S> for AuthorizeLayer {
    type Service = Authorize<S>;

    fn layer(&self, inner: S) -> Authorize<S> {
        Authorize { inner, parameters: self.0.clone() }
    }
}

/// A route with an [`AuthorizeLayer`]. A service and not a function: that would cost every request two more
/// boxes.
#[derive(Clone)]
pub(in crate::http) struct Authorize<S> {
    inner: S,
    parameters: Arc<QueryParameters>,
}

impl<S> Authorize<S> {
    fn check(&self, request: &Request) -> Result<()> {
        let template = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str);
        let context = RequestContext::of(request.extensions())?;
        let route = RoutePermission::of(request.method().as_str(), template);
        if let Some(route) = route {
            context.matched(Route { method: route.method, template: route.template });
        }
        context.caller().authorize(route.map_or(Permission::Administer, |route| route.permission))?;
        self.parameters.check(template, request.method(), request.uri())
    }
}

impl<S: Service<Request, Response = Response>> Service<Request> for Authorize<S> {
    type Response = Response;
    type Error = S::Error;
    type Future = Either<S::Future, Ready<std::result::Result<Response, S::Error>>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<std::result::Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request) -> Self::Future {
        let checked = self.check(&request).map_err(|error| Box::new(ApiError::from(error).into_response()));
        match checked.and_then(|()| decoded(request)) {
            Ok(request) => Either::Left(self.inner.call(request)),
            Err(refusal) => Either::Right(ready(Ok(*refusal))),
        }
    }
}

/// The application on behalf of the request's caller.
pub(in crate::http) struct CallerApp(pub(in crate::http) App);

impl FromRequestParts<Rest> for CallerApp {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, rest: &Rest) -> ApiResult<Self> {
        let context = RequestContext::of(&parts.extensions)?;
        Ok(Self(rest.app.on_behalf_of(context.caller().clone())))
    }
}
