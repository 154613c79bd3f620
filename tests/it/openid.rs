//! Sign-in of people by OpenID Connect, at a small provider of the test's own.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::routing::{get, post};
use axum::{Json, Router};
use base64::Engine as _;
use base64::engine::general_purpose::{STANDARD, URL_SAFE_NO_PAD};
use http_body_util::BodyExt as _;
use ring::rand::SystemRandom;
use ring::signature::{ECDSA_P256_SHA256_FIXED_SIGNING, EcdsaKeyPair, KeyPair as _};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use tempfile::TempDir;

use crate::harness::{Answer, TestServer, data_folder, sightfix};

const CODE: &str = "a-code";
const REDIRECT_URL: &str = "http://localhost:8080/v1/session/openid/callback";

/// A provider that signs everybody in.
#[derive(Clone)]
struct Provider {
    url: String,
    key: Arc<EcdsaKeyPair>,
    sign_in: Arc<Mutex<SignIn>>,
}

/// The sign-in under way.
#[derive(Default)]
struct SignIn {
    challenge: String,
    claims: Value,
    /// Signs by another key than the published one.
    is_forged: bool,
}

fn new_key() -> EcdsaKeyPair {
    let random = SystemRandom::new();
    let pkcs8 = EcdsaKeyPair::generate_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, &random).expect("a key");
    EcdsaKeyPair::from_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, pkcs8.as_ref(), &random).expect("its own form")
}

impl Provider {
    async fn start() -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let url = format!("http://{}", listener.local_addr().expect("an address"));
        let provider = Self { url, key: Arc::new(new_key()), sign_in: Arc::default() };
        let routes = Router::new()
            .route("/.well-known/openid-configuration", get(describe))
            .route("/keys", get(list_keys))
            .route("/token", post(redeem))
            .with_state(provider.clone());
        tokio::spawn(async { axum::serve(listener, routes).await });
        provider
    }

    fn claims(&self, nonce: &str) -> Value {
        #[expect(clippy::disallowed_methods, reason = "the server reads the wall clock, too")]
        let now = jiff::Timestamp::now().as_second();
        json!({
            "iss": self.url, "sub": "7", "aud": "sightfix", "iat": now, "exp": now + 300, "nonce": nonce,
            "preferred_username": "ada", "groups": ["staff", "site-operators"]
        })
    }

    fn sign(&self, sign_in: &SignIn) -> String {
        let encoded = |value: &Value| URL_SAFE_NO_PAD.encode(value.to_string());
        let signed =
            format!("{}.{}", encoded(&json!({ "alg": "ES256", "kid": "1" })), encoded(&sign_in.claims));
        let forged = new_key();
        let key = if sign_in.is_forged { &forged } else { &*self.key };
        let signature = key.sign(&SystemRandom::new(), signed.as_bytes()).expect("a signature");
        format!("{signed}.{}", URL_SAFE_NO_PAD.encode(signature))
    }
}

async fn describe(State(provider): State<Provider>) -> Json<Value> {
    let url = &provider.url;
    Json(json!({
        "issuer": url, "authorization_endpoint": format!("{url}/authorize?tenant=1"),
        "token_endpoint": format!("{url}/token"), "jwks_uri": format!("{url}/keys")
    }))
}

async fn list_keys(State(provider): State<Provider>) -> Json<Value> {
    let point = provider.key.public_key().as_ref();
    let [x, y] = [&point[1..33], &point[33..]].map(|part| URL_SAFE_NO_PAD.encode(part));
    Json(json!({ "keys": [{ "kty": "EC", "crv": "P-256", "x": x, "y": y, "kid": "1", "use": "sig" }] }))
}

async fn redeem(
    State(provider): State<Provider>,
    headers: HeaderMap,
    body: String,
) -> (StatusCode, Json<Value>) {
    let sign_in = provider.sign_in.lock().expect("no panic");
    let form: HashMap<_, _> = form_urlencoded::parse(body.as_bytes()).into_owned().collect();
    let verifier = &form["code_verifier"];
    let challenge = URL_SAFE_NO_PAD.encode(Sha256::digest(verifier));
    assert_eq!(headers["authorization"], format!("Basic {}", STANDARD.encode("sightfix:s3cret")));
    assert_eq!(form["redirect_uri"], REDIRECT_URL);
    if form["code"] != CODE || challenge != sign_in.challenge {
        return (StatusCode::BAD_REQUEST, Json(json!({ "error": "invalid_grant" })));
    }
    (StatusCode::OK, Json(json!({ "id_token": provider.sign(&sign_in), "token_type": "Bearer" })))
}

/// A server whose people sign in at a provider.
async fn start() -> (TempDir, TestServer, Provider) {
    let (folder, provider) = (data_folder(), Provider::start().await);
    let secret = folder.path().join("secret");
    std::fs::write(&secret, "s3cret\n").expect("a file");
    let server = TestServer::start_with(
        folder.path(),
        &[
            ("SIGHTFIX_OPENID__ISSUER", &provider.url),
            ("SIGHTFIX_OPENID__CLIENT_ID", "sightfix"),
            ("SIGHTFIX_OPENID__CLIENT_SECRET_FILE", secret.to_str().expect("UTF-8")),
            ("SIGHTFIX_OPENID__REDIRECT_URL", REDIRECT_URL),
            ("SIGHTFIX_OPENID__OPERATORS", "site-operators,other"),
        ],
    );
    (folder, server, provider)
}

/// The state of a browser after it was sent to the provider.
struct Begun {
    cookie: String,
    state: String,
    nonce: String,
    challenge: String,
}

fn cookie_of(answer: &Answer, name: &str) -> String {
    let cookies = answer.headers.get_all("set-cookie").iter().map(|value| value.to_str().expect("ASCII"));
    let cookie = cookies.into_iter().find(|cookie| cookie.starts_with(name)).expect("the cookie");
    cookie.split(';').next().expect("a pair").to_owned()
}

async fn begin(server: &TestServer, provider: &Provider) -> Begun {
    let answer = server.get("/v1/session/openid").await.expect(303);
    let location = answer.header("location").to_owned();
    let query =
        location.strip_prefix(&format!("{}/authorize?tenant=1&", provider.url)).expect("the provider's");
    let parameters: HashMap<_, _> = form_urlencoded::parse(query.as_bytes()).into_owned().collect();
    assert_eq!(parameters["response_type"], "code");
    assert_eq!(parameters["client_id"], "sightfix");
    assert_eq!(parameters["redirect_uri"], REDIRECT_URL);
    assert_eq!(parameters["scope"], "openid profile email");
    assert_eq!(parameters["code_challenge_method"], "S256");
    let cookie = cookie_of(&answer, "sightfix_sign_in");
    let shown = cookie.split_once('=').expect("a pair").1;
    assert!(!location.contains(shown), "the browser alone has the secret");
    Begun {
        cookie,
        state: parameters["state"].clone(),
        nonce: parameters["nonce"].clone(),
        challenge: parameters["code_challenge"].clone(),
    }
}

async fn come_back(server: &TestServer, cookie: &str, query: &str) -> Answer {
    let path = format!("/v1/session/openid/callback?{query}");
    server.send("GET", &path, &[("cookie", cookie)], "").await
}

/// Signs in as a person whose claims are changed by a function; the answer to the browser that comes back.
async fn sign_in(server: &TestServer, provider: &Provider, change: impl FnOnce(&mut SignIn)) -> Answer {
    let begun = begin(server, provider).await;
    let mut sign_in =
        SignIn { challenge: begun.challenge, claims: provider.claims(&begun.nonce), is_forged: false };
    change(&mut sign_in);
    *provider.sign_in.lock().expect("no panic") = sign_in;
    // Providers add parameters of their own.
    come_back(server, &begun.cookie, &format!("code={CODE}&state={}&session_state=x&iss=y", begun.state))
        .await
}

#[tokio::test]
async fn a_person_signs_in_and_has_the_role_of_their_group_until_they_sign_out() {
    let (_folder, server, provider) = start().await;
    assert_eq!(server.get("/v1/session/methods").await.expect(200).json(), json!({ "openid": true }));
    server.get("/v1/cameras").await.expect(401);
    let answer = sign_in(&server, &provider, |_| ()).await.expect(303);
    assert_eq!(answer.header("location"), "/");
    let cookie = cookie_of(&answer, "sightfix_session");
    let origin = format!("http://{}", server.address);
    let headers = [("cookie", &*cookie), ("origin", &*origin), ("content-type", "application/json")];
    let session = server.send("GET", "/v1/session", &headers, "").await.expect(200).json();
    assert_eq!(session["role"], "operator");
    assert_eq!(session["name"], "user 7 (ada)");
    server.send("POST", "/v1/cameras", &headers, r#"{"id":"c"}"#).await.expect(201);
    server.send("GET", "/v1/keys", &headers, "").await.expect(403);
    let audit = server.send("GET", "/v1/audit", &headers, "").await.expect(200).json();
    let actions = audit["items"].as_array().expect("items").iter();
    let of_person: Vec<&Value> =
        actions.filter(|it| it["actor"] == "user 7 (ada)").map(|it| &it["action"]).collect();
    assert_eq!(of_person, ["camera-created", "signed-in"], "{audit}");

    let mut events = server.open("GET", "/v1/cameras/c/events", &headers, "").await.into_body();
    server.send("DELETE", "/v1/session", &headers, "").await.expect(204);
    server.send("GET", "/v1/session", &headers, "").await.expect(401);
    // Open streams end with the session.
    while let Some(Ok(_)) = events.frame().await {}
}

#[tokio::test]
async fn people_have_idempotency_keys_of_their_own_in_all_their_sessions() {
    let (_folder, server, provider) = start().await;
    let origin = format!("http://{}", server.address);
    let import = async |subject: &str, name: &str, left_px: u32| {
        let answer = sign_in(&server, &provider, |sign_in| {
            sign_in.claims["sub"] = json!(subject);
            sign_in.claims["preferred_username"] = json!(name);
        })
        .await
        .expect(303);
        let cookie = cookie_of(&answer, "sightfix_session");
        let headers = [("cookie", &*cookie), ("origin", &*origin), ("content-type", "application/json")];
        server.send("POST", "/v1/cameras", &headers, r#"{"id":"c"}"#).await;
        let headers = [
            ("cookie", &*cookie),
            ("origin", &*origin),
            ("content-type", "text/csv"),
            ("idempotency-key", "import-1"),
        ];
        let csv = format!(
            "time,target_id,left,top,width,height,longitude,latitude\n\
             2020-12-14T06:41:0{subject}Z,a,{left_px},11,28,77,103.98678,30.6280135\n"
        );
        server.send("POST", "/v1/cameras/c/samples", &headers, csv).await
    };
    assert_eq!(import("1", "ada", 10).await.expect(200).json()["accepted"], 1);
    let other = import("2", "ada", 20).await.expect(200).json();
    assert_eq!(other["accepted"], 1, "the key of another person is another key");
    let again = import("1", "ada lovelace", 10).await.expect(200).json();
    assert_eq!(again["accepted"], 1, "the answer of the first, although it is another session: {again}");
    import("1", "ada", 30).await.expect(422);
}

#[tokio::test]
async fn what_does_not_hold_signs_nobody_in() {
    let (_folder, server, provider) = start().await;
    type Change = fn(&mut SignIn);
    let changes: [(&str, u16, Change); 8] = [
        ("another nonce", 401, |it| it.claims["nonce"] = json!("other")),
        ("another client", 401, |it| it.claims["aud"] = json!("other")),
        ("another issuer", 401, |it| it.claims["iss"] = json!("http://other.example")),
        ("expired", 401, |it| it.claims["exp"] = json!(1_000_000_000)),
        ("no expiry", 401, |it| it.claims["exp"] = Value::Null),
        ("another key", 401, |it| it.is_forged = true),
        ("another browser's PKCE", 401, |it| it.challenge.push('x')),
        ("no role", 403, |it| it.claims["groups"] = json!(["staff"])),
    ];
    for (name, status, change) in changes {
        let answer = sign_in(&server, &provider, change).await;
        assert_eq!(answer.status.as_u16(), status, "{name}: {}", answer.text());
        assert!(!answer.headers.contains_key("set-cookie"), "{name}");
    }
    let [mine, other] = [begin(&server, &provider).await, begin(&server, &provider).await];
    assert_ne!(mine.state, other.state);
    come_back(&server, &other.cookie, &format!("code={CODE}&state={}", mine.state)).await.expect(401);
    come_back(&server, "a=b", &format!("code={CODE}&state={}", mine.state)).await.expect(401);
    come_back(&server, &mine.cookie, "error=access_denied").await.expect(401);
    come_back(&server, &mine.cookie, &format!("code=other&state={}", mine.state)).await.expect(401);
}

#[tokio::test]
async fn a_person_who_is_refused_is_led_to_the_console() {
    let (_folder, server, provider) = start().await;
    let accept = ("accept", "text/html,application/xhtml+xml;q=0.9,*/*;q=0.8");
    let begun = begin(&server, &provider).await;
    let mut sign_in =
        SignIn { challenge: begun.challenge, claims: provider.claims(&begun.nonce), is_forged: false };
    sign_in.claims["groups"] = json!(["staff"]);
    *provider.sign_in.lock().expect("no panic") = sign_in;
    let cookie = ("cookie", &*begun.cookie);
    for (query, problem) in [
        (format!("code={CODE}&state={}", begun.state), "permission-denied"),
        ("error=access_denied".to_owned(), "unauthenticated"),
    ] {
        let path = format!("/v1/session/openid/callback?{query}");
        let answer = server.send("GET", &path, &[cookie, accept], "").await.expect(303);
        assert_eq!(answer.header("location"), format!("/#/sign-in/{problem}"));
        assert!(!answer.headers.contains_key("set-cookie"));
    }
}

#[tokio::test]
async fn a_provider_that_does_not_answer_is_named_in_the_log_alone() {
    let folder = data_folder();
    let server = TestServer::start_with(
        folder.path(),
        &[
            ("SIGHTFIX_OPENID__ISSUER", "http://127.0.0.1:9"),
            ("SIGHTFIX_OPENID__CLIENT_ID", "sightfix"),
            ("SIGHTFIX_OPENID__CLIENT_SECRET", "s3cret"),
            ("SIGHTFIX_OPENID__REDIRECT_URL", REDIRECT_URL),
            ("SIGHTFIX_OPENID__VIEWERS", "*"),
        ],
    );
    let refused = server.get("/v1/session/openid").await.expect(502);
    assert!(!refused.text().contains("127.0.0.1:9"), "{}", refused.text());
    let led = server.send("GET", "/v1/session/openid", &[("accept", "text/html")], "").await.expect(303);
    assert_eq!(led.header("location"), "/#/sign-in/sign-in-unavailable");
    server.logged(|entry| entry["issuer"] == "http://127.0.0.1:9").await;
    assert!(server.log_lines("s3cret").is_empty());
}

#[tokio::test]
async fn without_a_provider_there_is_none() {
    let folder = data_folder();
    let server = TestServer::start(folder.path());
    assert_eq!(server.get("/v1/session/methods").await.expect(200).json(), json!({ "openid": false }));
    server.get("/v1/session/openid").await.expect(404);
    server.get("/v1/session/openid/callback?code=a&state=b").await.expect(401);
}

#[test]
fn settings_that_cannot_be_used_are_named() {
    let refusal = |settings: &[(&str, &str)]| {
        let output = sightfix()
            .arg("config")
            .env("SIGHTFIX_OPENID__ISSUER", "https://login.example.org")
            .envs(settings.iter().copied())
            .output()
            .expect("the binary runs");
        assert!(!output.status.success());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let redirect = ("SIGHTFIX_OPENID__REDIRECT_URL", REDIRECT_URL);
    let client = ("SIGHTFIX_OPENID__CLIENT_ID", "sightfix");
    assert!(refusal(&[]).contains("openid.redirect_url"));
    assert!(refusal(&[redirect]).contains("openid.client_id"));
    assert!(refusal(&[redirect, client]).contains("openid.viewers"));
    let plain = ("SIGHTFIX_OPENID__ISSUER", "http://login.example.org");
    assert!(refusal(&[redirect, client, plain]).contains("openid.issuer"));
}
