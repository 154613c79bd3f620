//! Verification of ID tokens: signatures (RFC 7515, RFC 7518) by ring, claims by OpenID Connect Core 1.0, 3.1.3.7.

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use jiff::Timestamp;
use ring::signature::{
    ECDSA_P256_SHA256_FIXED, RSA_PKCS1_2048_8192_SHA256, RsaPublicKeyComponents, UnparsedPublicKey,
};
use serde::Deserialize;
use serde_json::{Map, Value};

/// By how much the provider's clock may differ from ours, s.
const CLOCK_DIFFERENCE_S: i64 = 60;

/// Keys that a provider signs with (RFC 7517).
#[derive(Deserialize)]
pub(super) struct KeySet {
    keys: Vec<Value>,
}

/// A key; others than those for signatures by RSA and on P-256 are of no use here.
#[derive(Deserialize)]
struct Key {
    #[serde(flatten)]
    kind: KeyKind,
    kid: Option<String>,
    #[serde(rename = "use")]
    purpose: Option<String>,
    alg: Option<Algorithm>,
}

#[derive(Deserialize)]
#[serde(tag = "kty")]
enum KeyKind {
    #[serde(rename = "RSA")]
    Rsa { n: String, e: String },
    #[serde(rename = "EC")]
    Elliptic { crv: Curve, x: String, y: String },
}

#[derive(Deserialize)]
enum Curve {
    #[serde(rename = "P-256")]
    P256,
}

/// The algorithms that are taken. `none` and those with a shared secret are not among them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
enum Algorithm {
    #[serde(rename = "RS256")]
    Rs256,
    #[serde(rename = "ES256")]
    Es256,
}

#[derive(Deserialize)]
struct Header {
    alg: Algorithm,
    kid: Option<String>,
    /// Extensions that must be understood; none is.
    crit: Option<Value>,
}

#[derive(Deserialize)]
struct Claims {
    iss: String,
    sub: String,
    aud: Audience,
    azp: Option<String>,
    exp: f64,
    iat: f64,
    nbf: Option<f64>,
    nonce: Option<String>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Audience {
    One(String),
    Several(Vec<String>),
}

/// The values that a token must contain.
pub(super) struct Expected<'e> {
    pub(super) issuer: &'e str,
    pub(super) client_id: &'e str,
    pub(super) nonce: &'e str,
    pub(super) now: Timestamp,
}

/// The claims of a token that holds; else what is wrong with it.
pub(super) fn verify(
    token: &str,
    keys: &KeySet,
    expected: &Expected<'_>,
) -> Result<Map<String, Value>, &'static str> {
    let (signed, signature) = token.rsplit_once('.').ok_or("it is no JWT")?;
    let (header, claims) = signed.split_once('.').ok_or("it is no JWT")?;
    let header: Header = serde_json::from_slice(&decoded(header)?)
        .map_err(|_| "its header cannot be read, or names an algorithm other than RS256 and ES256")?;
    if header.crit.is_some() {
        return Err("it has extensions that are unknown here");
    }
    let signature = decoded(signature)?;
    let mut candidates = keys.keys.iter().filter_map(|key| Key::deserialize(key).ok());
    if !candidates.any(|key| key.is_for(&header) && key.verifies(header.alg, signed, &signature)) {
        return Err("none of the provider's keys has signed it");
    }
    let claims = decoded(claims)?;
    let checked: Claims =
        serde_json::from_slice(&claims).map_err(|_| "a claim is missing or of a wrong type")?;
    checked.check(expected)?;
    serde_json::from_slice(&claims).map_err(|_| "its claims are no object")
}

fn decoded(part: &str) -> Result<Vec<u8>, &'static str> {
    URL_SAFE_NO_PAD.decode(part).map_err(|_| "it is not base64url")
}

impl Key {
    fn is_for(&self, header: &Header) -> bool {
        self.purpose.as_deref().is_none_or(|purpose| purpose == "sig")
            && self.alg.is_none_or(|alg| alg == header.alg)
            && (header.kid.is_none() || self.kid == header.kid)
    }

    /// The key's own kind decides, so that no token can have a key used for another algorithm.
    fn verifies(&self, algorithm: Algorithm, signed: &str, signature: &[u8]) -> bool {
        let verified = match (&self.kind, algorithm) {
            (KeyKind::Rsa { n, e }, Algorithm::Rs256) => decoded(n).and_then(|n| {
                let key = RsaPublicKeyComponents { n, e: decoded(e)? };
                let verified = key.verify(&RSA_PKCS1_2048_8192_SHA256, signed.as_bytes(), signature);
                verified.map_err(|_| "")
            }),
            (KeyKind::Elliptic { crv: Curve::P256, x, y }, Algorithm::Es256) => decoded(x).and_then(|x| {
                // An uncompressed point (SEC 1, 2.3.3).
                let point = [vec![4], x, decoded(y)?].concat();
                let key = UnparsedPublicKey::new(&ECDSA_P256_SHA256_FIXED, point);
                key.verify(signed.as_bytes(), signature).map_err(|_| "")
            }),
            _ => Err(""),
        };
        verified.is_ok()
    }
}

impl Claims {
    fn check(&self, expected: &Expected<'_>) -> Result<(), &'static str> {
        let now = expected.now.as_second();
        let [earliest, latest] = [now - CLOCK_DIFFERENCE_S, now + CLOCK_DIFFERENCE_S].map(|at| at as f64);
        let audience = match &self.aud {
            Audience::One(audience) => std::slice::from_ref(audience),
            Audience::Several(audience) => audience,
        };
        let is_ours = audience.iter().any(|audience| audience == expected.client_id);
        let is_authorized = match &self.azp {
            Some(authorized) => authorized == expected.client_id,
            None => audience.len() == 1,
        };
        let conditions = [
            (self.iss == expected.issuer, "it is of another issuer"),
            (is_ours && is_authorized, "it is for another client"),
            (!self.sub.is_empty(), "it names no subject"),
            (self.exp > earliest, "it has expired"),
            (self.iat <= latest && self.nbf.is_none_or(|begin| begin <= latest), "it is of the future"),
            (self.nonce.as_deref() == Some(expected.nonce), "it is of another sign-in"),
        ];
        conditions.into_iter().find(|(holds, _)| !holds).map_or(Ok(()), |(_, reason)| Err(reason))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// An ID token that OpenSSL has signed by RS256, and the modulus of its key.
    const TOKEN: &str = "eyJhbGciOiJSUzI1NiIsImtpZCI6IjEifQ.eyJpc3MiOiJodHRwczovL2lzc3Vlci5leGFtcGxlIiwic3ViIjoiNyIsImF1ZCI6I\
         nNpZ2h0Zml4IiwiZXhwIjoxNzAwMDAwMzAwLCJpYXQiOjE3MDAwMDAwMDAsIm5vbmNlIjoibiJ9.Yn333sbrZtDTn55Mt3R16NeT\
         E2cg0bIwLPh9iNpe-TLoA4IdunY7rNkg8wEYc7_Rk6TTQZT1QFAWjRQl7wlrVZdhk41y9nyF8jAJveSmourHKFuweSYTxDGxfEah\
         EOs5JyVySJSIAw4Dc8wzNw3VFw1eFr8xOqW__VFAtWnD7IQGG9VcFRy9piIHEQncdMB0J6xLD0RFKq6-NrcXuuJa6JQCvQIM3Ro3\
         DDuoTJUw9hQDIqLb7JIvCoLZa6bskxoPagDHvEn7wdGrHfrJ82Y74mfAmURwC_t8CgfLoq-6wlFXZ1YqmF2USzH22ukLo-osmLgO\
         ySJFWw7kV9UnSbHGJw";
    const MODULUS: &str = "qzJQ4xg6mYOrR9owjJjLPp-lGeeI-H5gLHWT7C1voEam_Wk3id5qXPbinptTGLYiNGm0GIN3rKrbpszRyZG1afE9DZs95Ju-5Mj9\
         N-EaMs2Iif8YVSaZJzrgEaXZHKteLTa_3fJ4szG_xAYRVoiPFmAh-VbA4v5EbVU90-sPFrQuqdpOvi2BvYEwE6r3JExdMm3_99zl\
         cG9RIbV5j-lo4KbVM1dU5PEwYpsgNUR8x5Hog4BJXTHjVzjSIt9CxuUK_KsOmnAaz0bO1oCaUd4vqFknZsEspynraT6cMzJc3t8x\
         QnzxAkSfQsl7_Q_BE38pXxZJa0CETO5JXX3AAclyvQ";
    const ISSUED_AT_S: i64 = 1_700_000_000;

    fn keys(key: Value) -> KeySet {
        KeySet { keys: vec![json!({ "kty": "OKP", "crv": "Ed25519", "x": "AA" }), key] }
    }

    fn key_of_the_token() -> Value {
        json!({ "kty": "RSA", "n": MODULUS, "e": "AQAB", "kid": "1", "use": "sig", "alg": "RS256" })
    }

    /// The fault of a token, if any, this long after it was issued.
    fn fault(token: &str, keys: &KeySet, nonce: &str, after_s: i64) -> Option<&'static str> {
        let now = Timestamp::from_second(ISSUED_AT_S + after_s).expect("in range");
        let expected = Expected { issuer: "https://issuer.example", client_id: "sightfix", nonce, now };
        verify(token, keys, &expected).err()
    }

    #[test]
    fn a_token_holds_for_its_sign_in_and_its_time() {
        let keys = keys(key_of_the_token());
        assert_eq!(fault(TOKEN, &keys, "n", 1), None);
        assert_eq!(fault(TOKEN, &keys, "n", 359), None, "the clocks may differ by a minute");
        assert_eq!(fault(TOKEN, &keys, "n", 361), Some("it has expired"));
        assert_eq!(fault(TOKEN, &keys, "n", -61), Some("it is of the future"));
        assert_eq!(fault(TOKEN, &keys, "m", 1), Some("it is of another sign-in"));
    }

    #[test]
    fn only_the_key_of_the_token_verifies_it() {
        let unsigned = Some("none of the provider's keys has signed it");
        for (name, value) in [("kid", "2"), ("use", "enc"), ("alg", "ES256"), ("e", "AQAC"), ("n", "AQAB")] {
            let mut key = key_of_the_token();
            key[name] = json!(value);
            assert_eq!(fault(TOKEN, &keys(key), "n", 1), unsigned, "{name}");
        }
        let keys = keys(key_of_the_token());
        let (signed, signature) = TOKEN.rsplit_once('.').expect("a JWT");
        let other = format!("{signed}.{}", signature.replacen('A', "B", 1));
        assert_eq!(fault(&other, &keys, "n", 1), unsigned);
        assert_eq!(fault(&format!("{signed}."), &keys, "n", 1), unsigned);
    }

    #[test]
    fn the_token_does_not_choose_how_it_is_verified() {
        let keys = keys(key_of_the_token());
        let (_, rest) = TOKEN.split_once('.').expect("a JWT");
        for algorithm in ["none", "HS256", "ES256", "rs256"] {
            let header = URL_SAFE_NO_PAD.encode(json!({ "alg": algorithm }).to_string());
            assert!(fault(&format!("{header}.{rest}"), &keys, "n", 1).is_some(), "{algorithm}");
        }
        let header = URL_SAFE_NO_PAD.encode(json!({ "alg": "RS256", "crit": ["b64"] }).to_string());
        let fault = fault(&format!("{header}.{rest}"), &keys, "n", 1);
        assert_eq!(fault, Some("it has extensions that are unknown here"));
    }

    #[test]
    fn claims_are_for_this_client_alone() {
        let check = |changes: Value| {
            let mut claims = json!({
                "iss": "i", "sub": "7", "aud": "sightfix", "exp": ISSUED_AT_S + 300, "iat": ISSUED_AT_S, "nonce": "n"
            });
            for (name, value) in changes.as_object().expect("an object") {
                claims[name] = value.clone();
            }
            let claims = serde_json::from_value::<Claims>(claims).map_err(|_| "unreadable")?;
            let now = Timestamp::from_second(ISSUED_AT_S).expect("in range");
            claims.check(&Expected { issuer: "i", client_id: "sightfix", nonce: "n", now })
        };
        assert_eq!(check(json!({})), Ok(()));
        assert_eq!(check(json!({ "aud": ["other", "sightfix"], "azp": "sightfix" })), Ok(()));
        for wrong in [
            json!({ "iss": "j" }),
            json!({ "aud": "other" }),
            json!({ "aud": ["other", "sightfix"] }),
            json!({ "azp": "other" }),
            json!({ "sub": "" }),
            json!({ "exp": "9999999999" }),
            json!({ "exp": null }),
            json!({ "nbf": ISSUED_AT_S + 61 }),
            json!({ "nonce": null }),
        ] {
            assert!(check(wrong.clone()).is_err(), "{wrong}");
        }
    }
}
