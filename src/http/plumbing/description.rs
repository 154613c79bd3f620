//! The parts of the OpenAPI description that concern the interface as a whole, and every operation alike.

use std::collections::BTreeMap;

use utoipa::openapi::path::{Operation, PathItem};
use utoipa::openapi::security::{
    ApiKey, ApiKeyValue, HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme,
};
use utoipa::openapi::tag::TagBuilder;
use utoipa::openapi::{
    ContentBuilder, InfoBuilder, License, OpenApi, OpenApiBuilder, Ref, RefOr, Response, ResponseBuilder,
};

use super::problem::PROBLEM_JSON;
use crate::app::access::Permission;
use crate::domain::{ErrorKind, Role};
use crate::http::resources::session::SESSION_COOKIE;
use crate::operations::route_permission;
use crate::status;

const TAGS: [(&str, &str); 15] = [
    ("cameras", "Profiles of cameras that nobody calibrated"),
    ("sites", "Cameras whose targets are tracked together"),
    ("places", "Areas and lines on the ground: rules, events and statistics"),
    ("samples", "Boxes and fixes that cameras learn from"),
    ("training", "Background fits of a camera's model"),
    ("models", "Model versions that runs yield"),
    ("fusion", "Positions of targets"),
    ("tracks", "Targets as they move: tracks, histories and live events"),
    ("history", "Positions of finished tracks"),
    ("inference", "The Open Inference Protocol (KServe's V2): positions of boxes as tensors"),
    ("features", "OGC API Features: cameras, samples and tracks for GIS"),
    ("connections", "Other systems that give detections and fixes, or take positions"),
    ("evaluations", "Methods side by side on stored samples, against the truth"),
    ("access", "Keys that clients present, and sessions of browsers"),
    ("service", "Health and metrics of the server"),
];

/// Refusals that any operation may meet.
const ANY: [ErrorKind; 5] = [
    ErrorKind::Timeout,
    ErrorKind::Internal,
    ErrorKind::Overloaded,
    ErrorKind::RateLimited,
    ErrorKind::HostNotAllowed,
];
/// Refusals of operations that change something.
const OF_CHANGES: [ErrorKind; 1] = [ErrorKind::OriginNotAllowed];
/// Refusals of operations with a body.
const WITH_BODY: [ErrorKind; 3] =
    [ErrorKind::MalformedBody, ErrorKind::TooLarge, ErrorKind::UnsupportedMediaType];
/// Refusals of operations below a camera.
const BELOW_CAMERA: [ErrorKind; 1] = [ErrorKind::CameraNotFound];
/// Refusals of operations below a connection.
const BELOW_CONNECTION: [ErrorKind; 1] = [ErrorKind::ConnectionNotFound];
/// Refusals of operations below a site.
const BELOW_SITE: [ErrorKind; 1] = [ErrorKind::SiteNotFound];

pub(in crate::http) fn head() -> OpenApi {
    let info = InfoBuilder::new()
        .title("sightfix")
        .version(env!("CARGO_PKG_VERSION"))
        .description(Some(
            "Positions of targets from what an uncalibrated fixed camera sees and what a GNSS receiver says. \
             Every refusal is a problem (RFC 9457) with a stable `type`, the fields at fault, and the id of \
             the request. Units end the names: `_m`, `_m2`, `_px`, `_deg`, `_s`.",
        ))
        .license(Some(License::new("Apache-2.0")))
        .build();
    let tags = TAGS.map(|(name, text)| TagBuilder::new().name(name).description(Some(text)).build());
    OpenApiBuilder::new().info(info).tags(Some(tags)).build()
}

/// Gives each operation the problems that it has in common with others.
pub(in crate::http) fn add_problems(openapi: &mut OpenApi) {
    for (path, item) in &mut openapi.paths.paths {
        let is_service = !["/v1/", "/v2", "/ogc"].iter().any(|prefix| path.starts_with(prefix));
        // OGC API Features requires 400 for parameters at fault.
        let is_features = path.starts_with("/ogc");
        let is_below_camera = path.contains("{camera}");
        let [get, changes @ ..] = operations(item);
        let changes = changes.into_iter().flatten().map(|operation| (operation, true));
        for (operation, is_change) in get.into_iter().map(|operation| (operation, false)).chain(changes) {
            let mut kinds: Vec<ErrorKind> = Vec::new();
            if !is_service {
                kinds.extend(ANY);
                kinds.push(if is_features { ErrorKind::InvalidQuery } else { ErrorKind::InvalidArgument });
            }
            if is_change {
                kinds.extend(OF_CHANGES);
            }
            if operation.request_body.is_some() {
                kinds.extend(WITH_BODY);
            }
            if is_below_camera {
                kinds.extend(BELOW_CAMERA);
            }
            if path.contains("{connection}") {
                kinds.extend(BELOW_CONNECTION);
            }
            if path.contains("{place}") {
                kinds.push(ErrorKind::PlaceNotFound);
            }
            if path.contains("{site}") {
                kinds.extend(BELOW_SITE);
            }
            add(&mut operation.responses.responses, &kinds);
        }
    }
}

/// States which operations need a key or a session, and which role.
pub(in crate::http) fn add_security(openapi: &mut OpenApi) {
    let schemes = &mut openapi.components.get_or_insert_default().security_schemes;
    let key = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .description(Some(
            "A key of `POST /v1/keys` or `sightfix keys create`. Needed once the first key exists.",
        ))
        .build();
    schemes.insert(KEY_SCHEME.to_owned(), SecurityScheme::Http(key).into());
    let session = ApiKeyValue::with_description(
        SESSION_COOKIE,
        "The cookie of `POST /v1/session`, for pages of this server.",
    );
    schemes.insert(SESSION_SCHEME.to_owned(), SecurityScheme::ApiKey(ApiKey::Cookie(session)).into());
    for (path, item) in &mut openapi.paths.paths {
        let methods = ["GET", "POST", "PUT", "PATCH", "DELETE"];
        for (method, operation) in methods.into_iter().zip(operations(item)) {
            let Some(operation) = operation else { continue };
            let permission = route_permission(method, path);
            if permission == Permission::Public {
                continue;
            }
            let none: [&str; 0] = [];
            operation.security = Some(vec![
                SecurityRequirement::new(KEY_SCHEME, none),
                SecurityRequirement::new(SESSION_SCHEME, none),
            ]);
            let roles =
                Role::ALL.iter().filter(|role| permission.is_granted_to(**role)).map(|role| role.as_str());
            let roles = format!("Roles: {}.", roles.collect::<Vec<_>>().join(", "));
            let text = operation.description.take().filter(|text| !text.is_empty());
            operation.description =
                Some(text.map_or_else(|| roles.clone(), |text| format!("{text}\n\n{roles}")));
            add(&mut operation.responses.responses, &OF_CALLERS);
        }
    }
}

const KEY_SCHEME: &str = "key";
const SESSION_SCHEME: &str = "session";
/// Refusals of operations that are not for everybody.
const OF_CALLERS: [ErrorKind; 2] = [ErrorKind::Unauthenticated, ErrorKind::PermissionDenied];

fn operations(item: &mut PathItem) -> [Option<&mut Operation>; 5] {
    [item.get.as_mut(), item.post.as_mut(), item.put.as_mut(), item.patch.as_mut(), item.delete.as_mut()]
}

fn add(responses: &mut BTreeMap<String, RefOr<Response>>, kinds: &[ErrorKind]) {
    for kind in kinds {
        let row = status::of(*kind);
        responses.entry(row.http.to_string()).or_insert_with(|| {
            let content = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem"))).build();
            ResponseBuilder::new().description(row.title).content(PROBLEM_JSON, content).build().into()
        });
    }
}
