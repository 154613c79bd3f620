use serde_json::Value;

use super::*;
use crate::http::openapi;

fn described() -> Value {
    serde_json::to_value(openapi()).expect("JSON")
}

#[test]
fn every_operation_tells_its_problems() {
    let described = described();
    assert_eq!(described["openapi"], "3.1.0");
    let mut ids = Vec::new();
    for (path, item) in described["paths"].as_object().expect("paths") {
        for (method, operation) in item.as_object().expect("operations") {
            let responses = operation["responses"].as_object().expect("responses");
            ids.push(operation["operationId"].as_str().expect("an id").to_owned());
            for (status, response) in responses {
                let is_problem = response["content"].get("application/problem+json").is_some();
                // A redirection to another node says why as a problem does.
                let has_problem = status.as_str() >= "400" || status == "307";
                assert_eq!(is_problem, has_problem, "{method} {path} {status}");
            }
            let has = |status: &str| responses.contains_key(status);
            let refuses_arguments = ["/v1/", "/v2"].iter().any(|prefix| path.starts_with(prefix));
            assert_eq!(has("422"), refuses_arguments, "{method} {path}");
            assert!(has("400") || !path.starts_with("/ogc"), "{method} {path}");
            assert!(has("404") || !path.contains("{camera}"), "{method} {path}");
            assert!(has("413") || operation.get("requestBody").is_none(), "{method} {path}");
        }
    }
    let count = ids.len();
    ids.sort();
    ids.dedup();
    assert_eq!(ids.len(), count, "operation ids are unique");
}

#[test]
fn every_reference_leads_to_a_schema() {
    fn references(value: &Value, found: &mut Vec<String>) {
        match value {
            Value::Object(fields) => {
                found.extend(fields.get("$ref").and_then(Value::as_str).map(str::to_owned));
                fields.values().for_each(|field| references(field, found));
            }
            Value::Array(items) => items.iter().for_each(|item| references(item, found)),
            _ => {}
        }
    }
    let described = described();
    let mut found = Vec::new();
    references(&described, &mut found);
    assert!(!found.is_empty());
    for reference in found {
        let pointer = reference.strip_prefix('#').expect("a local reference");
        assert!(described.pointer(pointer).is_some(), "{reference}");
    }
}

#[test]
fn physical_names_end_with_their_units() {
    let described = described();
    for (name, schema) in described["components"]["schemas"].as_object().expect("schemas") {
        for property in schema["properties"].as_object().into_iter().flat_map(|all| all.keys()) {
            let bare =
                ["longitude", "latitude", "width", "height", "left", "top", "sigma", "r95", "variance"];
            assert!(!bare.contains(&property.as_str()), "{name}.{property}");
        }
    }
}

#[tokio::test]
async fn the_description_and_its_page_are_served_without_the_internet() {
    let rest = Rest::new().await;
    let served = rest.get("/openapi.json").await.expect(200).json();
    assert_eq!(served, described());
    let page = rest.get("/docs/").await.expect(200);
    assert!(page.header("content-type").starts_with("text/html"));
    for file in ["page.js", "page.css", "swagger/swagger-ui.css", "swagger/swagger-ui-bundle.js"] {
        assert!(page.text().contains(file), "{file}");
        let part = rest.get(&format!("/docs/{file}")).await.expect(200);
        assert!(!part.body.is_empty(), "{file}");
        if file == "page.js" {
            assert!(part.text().contains("/openapi.json"), "{}", part.text());
        }
    }
}

#[tokio::test]
async fn what_no_route_knows_is_a_problem() {
    let rest = Rest::with_camera().await;
    assert!(rest.get("/v1/nothing").await.problem(404, "route-not-found").is_empty());
    assert!(rest.get("/docs/nothing").await.problem(404, "route-not-found").is_empty());
    let answer = rest.send("PUT", "/v1/cameras", &[], Body::empty()).await;
    assert!(answer.header("allow").contains("POST"));
    answer.problem(405, "method-not-allowed");
    assert_eq!(rest.get("/v1/cameras/c?more=1").await.problem(422, "invalid-argument"), ["more"]);
    let head = rest.send("HEAD", "/v1/cameras/none", &[], Body::empty()).await.expect(404);
    assert!(head.body.is_empty());
}

#[tokio::test]
async fn the_service_tells_how_it_is() {
    let rest = Rest::with_camera().await;
    rest.get("/livez").await.expect(200);
    rest.get("/readyz").await.expect(200);
    let metrics = rest.get("/metrics").await.expect(200);
    assert!(metrics.text().contains("sightfix_fusions_total"), "{}", metrics.text());
    rest.shutdown.drain();
    rest.get("/readyz").await.problem(503, "shutting-down");
    rest.get("/livez").await.expect(200);
}
