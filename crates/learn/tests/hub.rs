//! Publishing and fetching against a stand-in for the hub on loopback that speaks its routes.

#![cfg(feature = "hub")]
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test")]

use e2h_learn::hub::{Publication, Settings, publish, resolve};
use e2h_policy::Checkpoint;
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

const TOKEN: &str = "hf_right";
const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";

/// What the stand-in does wrong.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Fault {
    None,
    /// Half of the weights, then the connection closes.
    BrokenTransfer,
    /// A server's error where the weights should be, with status 500, every time.
    ServerError,
    /// Weights of another policy.
    WrongBytes,
}

#[derive(Default)]
struct State {
    /// Repositories: commit, files by name.
    files: BTreeMap<String, BTreeMap<String, Vec<u8>>>,
    /// Method and path of every request.
    requests: Vec<String>,
    fault: Option<Fault>,
    /// Anonymous readers are refused.
    private: bool,
}

/// A hub of one process.
struct Hub {
    endpoint: String,
    state: Arc<Mutex<State>>,
}

struct Request {
    method: String,
    path: String,
    token: Option<String>,
    body: Vec<u8>,
}

fn read(stream: &mut BufReader<TcpStream>) -> Option<Request> {
    let mut line = String::new();
    stream.read_line(&mut line).ok().filter(|n| *n > 0)?;
    let mut words = line.split_whitespace();
    let (method, path) = (words.next()?.to_owned(), words.next()?.to_owned());
    let (mut length, mut token) = (0, None);
    loop {
        let mut line = String::new();
        stream.read_line(&mut line).ok()?;
        let Some((name, value)) = line.trim().split_once(": ") else { break };
        match name.to_lowercase().as_str() {
            "content-length" => length = value.parse().ok()?,
            "authorization" => token = value.strip_prefix("Bearer ").map(str::to_owned),
            _ => {}
        }
    }
    let mut body = vec![0; length];
    stream.read_exact(&mut body).ok()?;
    Some(Request { method, path, token, body })
}

fn answer(
    stream: &mut TcpStream,
    status: &str,
    headers: &[(&str, String)],
    body: &[u8],
    sent: usize,
    head: bool,
) {
    let mut text = format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\nConnection: close\r\n", body.len());
    for (name, value) in headers {
        text += &format!("{name}: {value}\r\n");
    }
    drop(stream.write_all(format!("{text}\r\n").as_bytes()));
    if !head {
        drop(stream.write_all(&body[..sent]));
    }
    drop(stream.flush());
}

fn base64(text: &str) -> Vec<u8> {
    let digit = |c: u8| match c {
        b'A'..=b'Z' => c - b'A',
        b'a'..=b'z' => c - b'a' + 26,
        b'0'..=b'9' => c - b'0' + 52,
        b'+' => 62,
        _ => 63,
    };
    let digits: Vec<u8> = text.bytes().filter(|c| *c != b'=').map(digit).collect();
    let group = |d: &[u8]| {
        let word = (0..4).fold(0_u32, |w, i| w << 6 | u32::from(d.get(i).copied().unwrap_or(0)));
        word.to_be_bytes()[1..d.len()].to_vec()
    };
    digits.chunks(4).flat_map(group).collect()
}

impl Hub {
    fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let state = Arc::new(Mutex::new(State::default()));
        let shared = state.clone();
        // Detached: it ends with the test's process.
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let shared = shared.clone();
                std::thread::spawn(move || serve(stream, &shared));
            }
        });
        Self { endpoint, state }
    }

    fn set(&self, change: impl FnOnce(&mut State)) {
        change(&mut self.state.lock().unwrap());
    }

    fn settings(&self, cache: &Path, token: Option<&str>) -> Settings {
        Settings {
            endpoint: self.endpoint.clone(),
            token: token.map(str::to_owned),
            cache: cache.to_owned(),
            offline: false,
        }
    }
}

fn serve(stream: TcpStream, state: &Mutex<State>) {
    let mut out = stream.try_clone().unwrap();
    let Some(request) = read(&mut BufReader::new(stream)) else { return };
    let mut state = state.lock().unwrap();
    state.requests.push(format!("{} {}", request.method, request.path));
    let head = request.method == "HEAD";
    let plain = |out: &mut TcpStream, status: &str, code: &str, body: &Value| {
        let headers = if code.is_empty() { vec![] } else { vec![("X-Error-Code", code.to_owned())] };
        let body = body.to_string();
        answer(out, status, &headers, body.as_bytes(), body.len(), head);
    };
    let writes = request.method == "POST";
    let known = request.token.as_deref() == Some(TOKEN);
    if (writes || state.private) && !known || request.token.is_some() && !known {
        plain(&mut out, "401 Unauthorized", "", &json!({"error": "Invalid username or password."}));
        return;
    }
    let parts: Vec<&str> = request.path.trim_start_matches('/').split('/').collect();
    match (request.method.as_str(), &parts[..]) {
        ("POST", ["api", "repos", "create"]) => {
            let asked: Value = serde_json::from_slice(&request.body).unwrap();
            let owner = asked["organization"].as_str().unwrap_or("me");
            let id = format!("{owner}/{}", asked["name"].as_str().unwrap());
            let url = format!("http://hub/{id}");
            if state.files.contains_key(&id) {
                plain(
                    &mut out,
                    "409 Conflict",
                    "",
                    &json!({"error": "You already created this model repo", "url": url}),
                );
            } else {
                state.files.insert(id.clone(), BTreeMap::new());
                plain(&mut out, "200 OK", "", &json!({"url": url, "name": id, "id": "1"}));
            }
        }
        ("POST", ["api", "models", _, _, "preupload", _]) => {
            let asked: Value = serde_json::from_slice(&request.body).unwrap();
            let mode = |f: &Value| json!({"path": f["path"], "uploadMode": "regular", "shouldIgnore": false});
            let files: Vec<Value> = asked["files"].as_array().unwrap().iter().map(mode).collect();
            plain(&mut out, "200 OK", "", &json!({"files": files}));
        }
        ("POST", ["api", "models", owner, name, "commit", _]) => {
            let text = String::from_utf8(request.body).unwrap();
            let repository = state.files.get_mut(&format!("{owner}/{name}")).unwrap();
            let mut lines = text.lines().map(|l| serde_json::from_str::<Value>(l).unwrap());
            assert_eq!(lines.next().unwrap()["key"], "header");
            for line in lines {
                assert_eq!((&line["key"], &line["value"]["encoding"]), (&json!("file"), &json!("base64")));
                let path = line["value"]["path"].as_str().unwrap().to_owned();
                repository.insert(path, base64(line["value"]["content"].as_str().unwrap()));
            }
            let url = format!("http://hub/{owner}/{name}/commit/{COMMIT}");
            let body = json!({"success": true, "commitUrl": url, "commitOid": COMMIT, "hookOutput": ""});
            plain(&mut out, "200 OK", "", &body);
        }
        ("GET" | "HEAD", [owner, name, "resolve", revision, file]) => {
            let Some(repository) = state.files.get(&format!("{owner}/{name}")) else {
                plain(&mut out, "404 Not Found", "RepoNotFound", &json!({"error": "Repository not found"}));
                return;
            };
            if !["main", COMMIT].contains(revision) {
                plain(&mut out, "404 Not Found", "RevisionNotFound", &json!({"error": "Invalid rev id"}));
                return;
            }
            let Some(bytes) = repository.get(*file) else {
                plain(&mut out, "404 Not Found", "EntryNotFound", &json!({"error": "Entry not found"}));
                return;
            };
            let mut bytes = bytes.clone();
            let weights = *file == "model.safetensors";
            let fault = state.fault.filter(|_| weights && !head).unwrap_or(Fault::None);
            let hash: String = Sha256::digest(&bytes).iter().map(|b| format!("{b:02x}")).collect();
            if fault == Fault::WrongBytes {
                bytes.iter_mut().rev().take(4).for_each(|b| *b ^= 1);
            }
            if fault == Fault::ServerError {
                bytes = b"an apology".to_vec(); // which hf-hub keeps as if it were the file
            }
            let headers = [("ETag", format!("\"{hash}\"")), ("X-Repo-Commit", COMMIT.to_owned())];
            let sent = if fault == Fault::BrokenTransfer { bytes.len() / 2 } else { bytes.len() };
            let status = if fault == Fault::ServerError { "500 Internal Server Error" } else { "200 OK" };
            drop(state);
            answer(&mut out, status, &headers, &bytes, sent, head);
        }
        _ => plain(&mut out, "404 Not Found", "", &json!({"error": format!("no route {}", request.path)})),
    }
}

fn published() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../checkpoints/nut_assembly")
}

fn publication(dir: &Path) -> Publication {
    let license = Some("mit".to_owned());
    Publication { address: "lab/nut".parse().unwrap(), dir: dir.to_owned(), private: false, license }
}

/// The checkpoint without its own card, so that one is made.
fn without_card(dir: &Path) -> PathBuf {
    let copy = dir.join("policy");
    std::fs::create_dir_all(&copy).unwrap();
    for file in ["policy.json", "model.safetensors", "results.json"] {
        std::fs::copy(published().join(file), copy.join(file)).unwrap();
    }
    copy
}

#[track_caller]
fn line(result: e2h_learn::Result<impl std::fmt::Debug>, words: &[&str]) {
    let message = match result {
        Ok(found) => panic!("expected {words:?}, found {found:?}"),
        Err(e) => e.to_string(),
    };
    assert_eq!(message.lines().count(), 1, "{message}");
    assert!(message.starts_with("hf://lab/nut"), "{message}");
    assert!(!message.contains("hf_"), "a token is told: {message}");
    for word in words {
        assert!(message.contains(word), "expected `{word}` in: {message}");
    }
}

/// Files in a folder and below, without locks and marks of absence.
fn files(dir: &Path) -> Vec<PathBuf> {
    let mut found = vec![];
    let mut folders = vec![dir.to_owned()];
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()) {
            let hidden = path.components().any(|c| c.as_os_str() == ".locks" || c.as_os_str() == ".no_exist");
            if path.is_dir() {
                folders.push(path);
            } else if !hidden {
                found.push(path);
            }
        }
    }
    found
}

#[test]
fn what_is_published_is_fetched_and_kept_for_offline() {
    let (hub, dir) = (Hub::start(), tempfile::tempdir().unwrap());
    let (cache, policy) = (dir.path().join("cache"), without_card(dir.path()));
    let settings = hub.settings(&cache, Some(TOKEN));
    let url = publish(&publication(&policy), &settings).unwrap();
    assert_eq!(url, format!("{}/lab/nut", hub.endpoint));
    {
        let state = hub.state.lock().unwrap();
        let names: Vec<&str> = state.files["lab/nut"].keys().map(String::as_str).collect();
        assert_eq!(names, ["README.md", "curve.svg", "model.safetensors", "policy.json", "results.json"]);
        for file in ["policy.json", "model.safetensors"] {
            assert!(state.files["lab/nut"][file] == std::fs::read(policy.join(file)).unwrap(), "{file}");
        }
        let card = String::from_utf8(state.files["lab/nut"]["README.md"].clone()).unwrap();
        for part in [
            "license: \"mit\"",
            "pipeline_tag: robotics",
            "(curve.svg)",
            "--example nut_assembly -- --preset laptop",
        ] {
            assert!(card.contains(part), "{part} in {card}");
        }
        // All in one commit.
        assert_eq!(state.requests.iter().filter(|r| r.contains("/commit/")).count(), 1);
    }
    // Again: the repository is there already. Its own card is used where it has one.
    publish(&publication(&published()), &settings).unwrap();
    let own = std::fs::read(published().join("README.md")).unwrap();
    assert!(hub.state.lock().unwrap().files["lab/nut"]["README.md"] == own);

    // Anybody may fetch what is public; both files are of one commit.
    let folder = resolve("hf://lab/nut", &hub.settings(&cache, None)).unwrap();
    assert!(folder.ends_with(COMMIT));
    let (there, weights) = Checkpoint::read(&folder).unwrap();
    let (here, same) = Checkpoint::read(&policy).unwrap();
    assert!(there == here && weights == same);
    let weights_of = format!("/resolve/{COMMIT}/model.safetensors");
    assert!(hub.state.lock().unwrap().requests.iter().any(|r| r.ends_with(&weights_of)));

    // A second time, and offline, nothing is transferred.
    let before = hub.state.lock().unwrap().requests.len();
    let offline = Settings { offline: true, ..hub.settings(&cache, None) };
    assert_eq!(resolve("hf://lab/nut", &offline).unwrap(), folder);
    assert_eq!(hub.state.lock().unwrap().requests.len(), before);
    assert_eq!(resolve(&format!("hf://lab/nut@{COMMIT}"), &hub.settings(&cache, None)).unwrap(), folder);
    let gets = |s: &State| s.requests.iter().filter(|r| r.starts_with("GET")).count();
    assert_eq!(gets(&hub.state.lock().unwrap()), 2);
}

#[test]
fn each_trouble_is_one_line_and_leaves_no_checkpoint() {
    let (hub, dir) = (Hub::start(), tempfile::tempdir().unwrap());
    let cache = dir.path().join("cache");
    let fetch = |token: Option<&str>, address: &str| resolve(address, &hub.settings(&cache, token));
    line(fetch(None, "hf://lab/nut"), &["no such repository", "HF_TOKEN"]);
    publish(&publication(&published()), &hub.settings(&cache, Some(TOKEN))).unwrap();

    line(fetch(Some("hf_wrong"), "hf://lab/nut"), &["refused the token", "HF_TOKEN"]);
    line(fetch(None, "hf://lab/nut@v9"), &["v9"]);
    hub.set(|s| s.private = true);
    line(fetch(None, "hf://lab/nut"), &["set HF_TOKEN"]);
    hub.set(|s| s.private = false);
    let offline = Settings { offline: true, ..hub.settings(&cache, None) };
    line(resolve("hf://lab/nut", &offline), &["HF_HUB_OFFLINE is set", "policy.json"]);
    let nobody = Settings { endpoint: "http://127.0.0.1:9".to_owned(), ..hub.settings(&cache, None) };
    line(resolve("hf://lab/nut", &nobody), &["cannot reach http://127.0.0.1:9"]);

    for (fault, words) in [
        (Fault::BrokenTransfer, ["broke off"]),
        (Fault::ServerError, ["removed from the cache"]),
        (Fault::WrongBytes, ["SHA-256"]),
    ] {
        hub.set(|s| s.fault = Some(fault));
        line(fetch(None, "hf://lab/nut"), &words);
        let left = files(&cache);
        let weights = |p: &PathBuf| p.ends_with("model.safetensors");
        assert!(!left.iter().any(weights), "{fault:?} left {left:?}");
        // The next try is as good as the first.
        hub.set(|s| s.fault = None);
        Checkpoint::read(&fetch(None, "hf://lab/nut").unwrap()).unwrap();
        std::fs::remove_dir_all(&cache).unwrap();
    }

    // A repository that holds something else.
    hub.set(|s| {
        s.files.insert("lab/nut".to_owned(), [("README.md".to_owned(), b"a poem".to_vec())].into());
    });
    line(fetch(None, "hf://lab/nut"), &["policy.json"]);
}

#[test]
fn nothing_is_sent_before_everything_is_known_to_be_right() {
    let (hub, dir) = (Hub::start(), tempfile::tempdir().unwrap());
    let settings = hub.settings(dir.path(), Some(TOKEN));
    let broken = without_card(dir.path());
    std::fs::write(broken.join("model.safetensors"), "torn").unwrap();
    let message = publish(&publication(&broken), &settings).unwrap_err().to_string();
    assert!(message.contains("SHA-256"), "{message}");
    let good = publication(&published());
    line(publish(&good, &hub.settings(dir.path(), None)), &["needs a token", "HF_TOKEN"]);
    line(publish(&good, &Settings { offline: true, ..settings.clone() }), &["HF_HUB_OFFLINE"]);
    assert!(hub.state.lock().unwrap().requests.is_empty());
    line(publish(&good, &hub.settings(dir.path(), Some("hf_wrong"))), &["refused the token"]);
}
