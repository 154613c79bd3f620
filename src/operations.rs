//! The operations of both transports, with the permission that each needs.

use std::collections::HashMap;
use std::sync::LazyLock;

use crate::app::access::Permission;
use crate::app::access::Permission::{Administer, Authenticated, Ingest, Operate, Public, Read};

/// An operation that a client can ask for, on either transport.
#[derive(Debug, Clone, Copy)]
pub struct Operation {
    /// The permission that it needs.
    pub permission: Permission,
    /// `METHOD template` of the REST route; empty without one.
    pub route: &'static str,
    /// `package.Service/Method` of the RPC; empty without one.
    pub rpc: &'static str,
}

const fn operation(permission: Permission, route: &'static str, rpc: &'static str) -> Operation {
    Operation { permission, route, rpc }
}

/// Every operation. A test compares the table with the routes and services that exist.
pub const OPERATIONS: &[Operation] = &[
    operation(Public, "GET /livez", "grpc.health.v1.Health/Check"),
    operation(Public, "GET /readyz", "grpc.health.v1.Health/Watch"),
    operation(Read, "GET /metrics", ""),
    operation(Read, "GET /v1/server", ""),
    operation(Operate, "DELETE /v1/demonstration", ""),
    operation(Read, "GET /v1/nodes", ""),
    operation(Read, "GET /v1/tiles", ""),
    operation(Read, "GET /v1/camera-statuses", ""),
    operation(Authenticated, "", "grpc.reflection.v1.ServerReflection/ServerReflectionInfo"),
    operation(Authenticated, "", "grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo"),
    operation(Public, "POST /v1/session", ""),
    operation(Authenticated, "GET /v1/session", ""),
    operation(Public, "GET /v1/session/methods", ""),
    operation(Public, "GET /v1/session/openid", ""),
    operation(Public, "DELETE /v1/session", ""),
    operation(Administer, "POST /v1/keys", "sightfix.v1.KeyService/CreateKey"),
    operation(Administer, "GET /v1/keys", "sightfix.v1.KeyService/ListKeys"),
    operation(Administer, "GET /v1/keys/{key}", "sightfix.v1.KeyService/GetKey"),
    operation(Administer, "DELETE /v1/keys/{key}", "sightfix.v1.KeyService/RevokeKey"),
    operation(Operate, "GET /v1/audit", "sightfix.v1.AuditService/ListAuditEntries"),
    operation(Operate, "POST /v1/cameras", "sightfix.v1.CameraService/CreateCamera"),
    operation(Read, "GET /v1/cameras", "sightfix.v1.CameraService/ListCameras"),
    operation(Read, "GET /v1/cameras/{camera}", "sightfix.v1.CameraService/GetCamera"),
    operation(Operate, "PATCH /v1/cameras/{camera}", "sightfix.v1.CameraService/UpdateCamera"),
    operation(Operate, "DELETE /v1/cameras/{camera}", "sightfix.v1.CameraService/DeleteCamera"),
    operation(Read, "GET /v1/cameras/{camera}/learning", "sightfix.v1.CameraService/GetLearning"),
    operation(Read, "GET /v1/cameras/{camera}/picture", ""),
    operation(Ingest, "POST /v1/cameras/{camera}/picture", ""),
    operation(Ingest, "PUT /v1/cameras/{camera}/picture", ""),
    operation(Operate, "DELETE /v1/cameras/{camera}/picture", ""),
    operation(Operate, "POST /v1/sites", "sightfix.v1.SiteService/CreateSite"),
    operation(Read, "GET /v1/sites", "sightfix.v1.SiteService/ListSites"),
    operation(Read, "GET /v1/sites/{site}", "sightfix.v1.SiteService/GetSite"),
    operation(Operate, "PATCH /v1/sites/{site}", "sightfix.v1.SiteService/UpdateSite"),
    operation(Operate, "DELETE /v1/sites/{site}", "sightfix.v1.SiteService/DeleteSite"),
    operation(Read, "GET /v1/sites/{site}/tracks", "sightfix.v1.SiteService/ListWorldTracks"),
    operation(Read, "GET /v1/sites/{site}/tracks/{track}", "sightfix.v1.SiteService/GetWorldTrack"),
    operation(Read, "GET /v1/sites/{site}/events", "sightfix.v1.SiteService/WatchTracks"),
    operation(Operate, "POST /v1/sites/{site}/training-runs", "sightfix.v1.SiteService/StartSiteTrainingRun"),
    operation(Read, "GET /v1/sites/{site}/training-runs", "sightfix.v1.SiteService/ListSiteTrainingRuns"),
    operation(Read, "GET /v1/sites/{site}/training-runs/{run}", "sightfix.v1.SiteService/GetSiteTrainingRun"),
    operation(
        Operate,
        "POST /v1/sites/{site}/training-runs/{run}/cancel",
        "sightfix.v1.SiteService/CancelSiteTrainingRun",
    ),
    operation(Operate, "POST /v1/places", "sightfix.v1.PlaceService/CreatePlace"),
    operation(Read, "GET /v1/places", "sightfix.v1.PlaceService/ListPlaces"),
    operation(Read, "GET /v1/places/{place}", "sightfix.v1.PlaceService/GetPlace"),
    operation(Operate, "PATCH /v1/places/{place}", "sightfix.v1.PlaceService/UpdatePlace"),
    operation(Operate, "DELETE /v1/places/{place}", "sightfix.v1.PlaceService/DeletePlace"),
    operation(Read, "GET /v1/places/{place}/statistics", "sightfix.v1.PlaceService/GetPlaceStatistics"),
    operation(Read, "GET /v1/place-events", "sightfix.v1.PlaceService/ListPlaceEvents"),
    operation(Read, "GET /v1/place-events/stream", "sightfix.v1.PlaceService/WatchPlaceEvents"),
    operation(Operate, "POST /v1/connections", ""),
    operation(Operate, "GET /v1/connections", ""),
    operation(Operate, "GET /v1/connections/{connection}", ""),
    operation(Operate, "PATCH /v1/connections/{connection}", ""),
    operation(Operate, "DELETE /v1/connections/{connection}", ""),
    operation(Operate, "POST /v1/connections/{connection}/test", ""),
    operation(Ingest, "POST /v1/connections/{connection}/messages", ""),
    operation(Ingest, "GET /v1/connections/{connection}/messages", ""),
    operation(Ingest, "POST /v1/connections/{connection}/messages/{key}", ""),
    operation(Ingest, "GET /v1/connections/{connection}/messages/{key}", ""),
    operation(Operate, "GET /v1/connections/{connection}/dead-letters", ""),
    operation(Operate, "DELETE /v1/connections/{connection}/dead-letters", ""),
    operation(Operate, "POST /v1/connections/{connection}/dead-letters/retry", ""),
    operation(Operate, "POST /v1/cameras/{camera}/gnss-error", "sightfix.v1.ModelService/EstimateGnssError"),
    operation(Ingest, "POST /v1/cameras/{camera}/samples", "sightfix.v1.SampleService/ImportSamples"),
    operation(Ingest, "POST /v1/cameras/{camera}/samples/pairings", "sightfix.v1.SampleService/PairSamples"),
    operation(Read, "GET /v1/cameras/{camera}/samples", "sightfix.v1.SampleService/ListSamples"),
    operation(Read, "GET /v1/cameras/{camera}/samples/count", "sightfix.v1.SampleService/CountSamples"),
    operation(Operate, "DELETE /v1/cameras/{camera}/samples", "sightfix.v1.SampleService/DeleteSamples"),
    operation(
        Operate,
        "POST /v1/cameras/{camera}/training-runs",
        "sightfix.v1.TrainingService/StartTrainingRun",
    ),
    operation(Read, "GET /v1/cameras/{camera}/training-runs", "sightfix.v1.TrainingService/ListTrainingRuns"),
    operation(
        Read,
        "GET /v1/cameras/{camera}/training-runs/{run}",
        "sightfix.v1.TrainingService/GetTrainingRun",
    ),
    operation(
        Operate,
        "DELETE /v1/cameras/{camera}/training-runs/{run}",
        "sightfix.v1.TrainingService/DeleteTrainingRun",
    ),
    operation(
        Operate,
        "POST /v1/cameras/{camera}/training-runs/{run}/cancel",
        "sightfix.v1.TrainingService/CancelTrainingRun",
    ),
    operation(
        Read,
        "GET /v1/cameras/{camera}/training-runs/{run}/events",
        "sightfix.v1.TrainingService/WatchTrainingRun",
    ),
    operation(
        Read,
        "GET /v1/cameras/{camera}/training-runs/{run}/log",
        "sightfix.v1.TrainingService/GetTrainingLog",
    ),
    operation(
        Read,
        "GET /v1/cameras/{camera}/training-runs/{run}/curve",
        "sightfix.v1.TrainingService/GetTrainingCurve",
    ),
    operation(Operate, "POST /v1/cameras/{camera}/models", "sightfix.v1.ModelService/ImportModel"),
    operation(Read, "GET /v1/cameras/{camera}/models", "sightfix.v1.ModelService/ListModels"),
    operation(Read, "GET /v1/cameras/{camera}/models/{model}", "sightfix.v1.ModelService/GetModel"),
    operation(Operate, "DELETE /v1/cameras/{camera}/models/{model}", "sightfix.v1.ModelService/DeleteModel"),
    operation(Read, "GET /v1/cameras/{camera}/models/{model}/file", "sightfix.v1.ModelService/DownloadModel"),
    operation(Read, "GET /v1/cameras/{camera}/active-model", ""),
    operation(Operate, "PUT /v1/cameras/{camera}/active-model", "sightfix.v1.ModelService/ActivateModel"),
    operation(
        Operate,
        "POST /v1/cameras/{camera}/active-model/roll-back",
        "sightfix.v1.ModelService/RollBackModel",
    ),
    operation(Ingest, "POST /v1/cameras/{camera}/fusions", "sightfix.v1.FusionService/Fuse"),
    operation(Ingest, "POST /v1/cameras/{camera}/tracks", "sightfix.v1.FusionService/Stream"),
    operation(Read, "GET /v1/cameras/{camera}/tracks", "sightfix.v1.TrackService/ListTracks"),
    operation(Read, "GET /v1/cameras/{camera}/tracks/{target}", "sightfix.v1.TrackService/GetTrack"),
    operation(Read, "GET /v1/cameras/{camera}/events", "sightfix.v1.TrackService/WatchCamera"),
    operation(Read, "GET /v1/history", "sightfix.v1.HistoryService/ListHistory"),
    operation(Read, "", "sightfix.v1.HistoryService/StreamHistory"),
    operation(Read, "GET /v1/history/heat-map", ""),
    operation(Operate, "DELETE /v1/history", "sightfix.v1.HistoryService/DeleteHistory"),
    operation(Operate, "POST /v1/evaluations", "sightfix.v1.EvaluationService/StartEvaluation"),
    operation(Read, "GET /v1/evaluations", "sightfix.v1.EvaluationService/ListEvaluations"),
    operation(Read, "GET /v1/evaluations/{evaluation}", "sightfix.v1.EvaluationService/GetEvaluation"),
    operation(
        Operate,
        "POST /v1/evaluations/{evaluation}/cancel",
        "sightfix.v1.EvaluationService/CancelEvaluation",
    ),
    operation(
        Operate,
        "DELETE /v1/evaluations/{evaluation}",
        "sightfix.v1.EvaluationService/DeleteEvaluation",
    ),
    operation(Public, "GET /v2/health/live", "inference.GRPCInferenceService/ServerLive"),
    operation(Public, "GET /v2/health/ready", "inference.GRPCInferenceService/ServerReady"),
    operation(Authenticated, "GET /v2", "inference.GRPCInferenceService/ServerMetadata"),
    operation(Read, "GET /v2/models/{camera}", "inference.GRPCInferenceService/ModelMetadata"),
    operation(Read, "GET /v2/models/{camera}/versions/{version}", ""),
    operation(Read, "GET /v2/models/{camera}/ready", "inference.GRPCInferenceService/ModelReady"),
    operation(Read, "GET /v2/models/{camera}/versions/{version}/ready", ""),
    operation(Ingest, "POST /v2/models/{camera}/infer", "inference.GRPCInferenceService/ModelInfer"),
    operation(Ingest, "POST /v2/models/{camera}/versions/{version}/infer", ""),
    operation(Read, "GET /ogc", ""),
    operation(Read, "GET /ogc/conformance", ""),
    operation(Read, "GET /ogc/collections", ""),
    operation(Read, "GET /ogc/collections/{collection}", ""),
    operation(Read, "GET /ogc/collections/{collection}/items", ""),
    operation(Read, "GET /ogc/collections/{collection}/items/{feature}", ""),
];

/// A REST route with the permission that it needs.
#[derive(Debug, Clone, Copy)]
pub struct RoutePermission {
    pub method: &'static str,
    /// The template of its path.
    pub template: &'static str,
    /// The permission that it needs.
    pub permission: Permission,
}

impl RoutePermission {
    /// The row of a route in the table, by its method and the template of its path; `None` if it is missing there.
    #[must_use]
    pub fn of(method: &str, template: &str) -> Option<Self> {
        // The router answers HEAD by the handler of GET.
        let method = if method == "HEAD" { "GET" } else { method };
        ROUTES.get(template)?.iter().find(|route| route.method == method).copied()
    }
}

/// Returns the permission for a REST route. A route that is missing in the table is for administrators only.
#[must_use]
pub fn route_permission(method: &str, template: &str) -> Permission {
    RoutePermission::of(method, template).map_or(Administer, |route| route.permission)
}

/// An RPC's name as the table has it, by its path; `None` if it is missing there.
#[must_use]
pub fn rpc_name(path: &str) -> Option<&'static str> {
    RPCS.get_key_value(path.strip_prefix('/').unwrap_or(path)).map(|(name, _)| *name)
}

/// Returns the permission for an RPC, by its path. One that is missing in the table is for administrators only.
#[must_use]
pub fn rpc_permission(path: &str) -> Permission {
    RPCS.get(path.strip_prefix('/').unwrap_or(path)).copied().unwrap_or(Administer)
}

static ROUTES: LazyLock<HashMap<&'static str, Vec<RoutePermission>>> = LazyLock::new(|| {
    let mut routes: HashMap<_, Vec<_>> = HashMap::new();
    for operation in OPERATIONS {
        if let Some((method, template)) = operation.route.split_once(' ') {
            let route = RoutePermission { method, template, permission: operation.permission };
            routes.entry(template).or_default().push(route);
        }
    }
    routes
});

static RPCS: LazyLock<HashMap<&'static str, Permission>> = LazyLock::new(|| {
    let rpcs = OPERATIONS.iter().filter(|operation| !operation.rpc.is_empty());
    rpcs.map(|operation| (operation.rpc, operation.permission)).collect()
});

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_in_the_table_is_for_administrators() {
        assert_eq!(route_permission("GET", "/v1/new-route"), Administer);
        assert_eq!(route_permission("PUT", "/v1/cameras"), Administer);
        assert_eq!(rpc_permission("/sightfix.v1.NewService/New"), Administer);
        assert_eq!(rpc_permission(""), Administer);
        assert_eq!(route_permission("HEAD", "/v1/cameras"), Read);
    }
}
