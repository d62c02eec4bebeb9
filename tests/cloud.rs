//! Captures and matrices in object stores, on loopback: a local S3 server (moto, from PyPI) where there is one, and a
//! plain server of this test's own. `cargo test --release --features cloud --test cloud`; `scripts/test_cloud.sh` installs the server
//! before that.

#[path = "common/mod.rs"]
mod common;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A signature that nobody verifies: the server takes it for that of a user.
const AUTHORIZATION: &str =
    "AWS4-HMAC-SHA256 Credential=key/20261201/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=0";
const CHUNK: &str = "slab.rd.zarr/response/c.1.0.0.0.0";

/// An S3 server that ends with the test.
struct S3 {
    server: Child,
    port: u16,
}

impl S3 {
    /// `None`, with the reason printed, where there is no server to run: `ACQUIRE_S3_SERVER` names `moto_server`.
    fn start() -> Option<Self> {
        let program = std::env::var("ACQUIRE_S3_SERVER").unwrap_or("moto_server".into());
        let port = free_port();
        let mut command = Command::new(&program);
        command.args(["-H", "127.0.0.1", "-p", &port.to_string()]).stdout(Stdio::null()).stderr(Stdio::null());
        let server = match command.spawn() {
            Ok(server) => server,
            Err(e) => {
                println!("skipped: {program} cannot be run ({e}); scripts/test_cloud.sh installs it");
                return None;
            }
        };
        let mut s3 = Self { server, port };
        let start = Instant::now();
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            let ended = s3.server.try_wait().unwrap().is_some();
            assert!(!ended && start.elapsed() < Duration::from_secs(120), "{program} does not answer on port {port}");
            std::thread::sleep(Duration::from_millis(100));
        }
        s3.put("", &[]);
        Some(s3)
    }

    /// Makes an object of the bucket; without a name, the bucket.
    fn put(&self, object: &str, bytes: &[u8]) {
        assert_eq!(self.request("PUT", object, bytes).0, 200, "{object}");
    }

    /// Status and body of a request for an object of the bucket.
    fn ask(&self, method: &str, object: &str) -> (u32, Vec<u8>) {
        self.request(method, object, &[])
    }

    fn request(&self, method: &str, object: &str, bytes: &[u8]) -> (u32, Vec<u8>) {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        let head = format!(
            "{method} /lab/{object} HTTP/1.0\r\nHost: 127.0.0.1\r\nContent-Length: {}\r\nAuthorization: {AUTHORIZATION}\r\n\r\n",
            bytes.len()
        );
        stream.write_all(head.as_bytes()).unwrap();
        stream.write_all(bytes).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let head = String::from_utf8_lossy(&answer[..end]).into_owned();
        (head.split(' ').nth(1).unwrap().parse().unwrap(), answer[end + 4..].to_vec())
    }

    /// The program, with the environment of this server alone.
    fn acquire(&self, folder: &Path, line: &str) -> (i32, String, String) {
        let mut command = common::command_in(folder, line);
        for (key, value) in [
            ("AWS_ENDPOINT_URL", format!("http://127.0.0.1:{}", self.port)),
            ("AWS_ALLOW_HTTP", "true".into()),
            ("AWS_ACCESS_KEY_ID", "key".into()),
            ("AWS_SECRET_ACCESS_KEY", "secret".into()),
            ("AWS_REGION", "us-east-1".into()),
        ] {
            command.env(key, value);
        }
        common::outcome(&mut command)
    }
}

impl Drop for S3 {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

fn done((status, out, err): (i32, String, String)) -> String {
    assert_eq!(status, 0, "{err}");
    out
}

fn refused((status, _, err): (i32, String, String), words: &[&str]) {
    assert_eq!(status, 1, "{err}");
    words.iter().for_each(|word| assert!(err.contains(word), "{word} in {err}"));
}

#[test]
fn a_matrix_is_written_read_and_replaced_in_an_object_store_as_in_a_folder() {
    let Some(s3) = S3::start() else { return };
    let folder = tempfile::tempdir().unwrap();
    let run = |line: &str| s3.acquire(folder.path(), line);
    let captures = Path::new(env!("CARGO_MANIFEST_DIR")).join("captures");
    let captures = captures.display();
    done(run(&format!("build-matrix {captures} --out slab.rd.zarr")));
    done(run(&format!("build-matrix {captures} --out s3://lab/slab.rd.zarr")));
    let local = common::files(&folder.path().join("slab.rd.zarr"));
    for (name, bytes) in &local {
        let (status, body) = s3.ask("GET", &format!("slab.rd.zarr/{name}"));
        assert!(status == 200 && body == *bytes, "{name}: {status}");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else is left here");
    // Each command that reads a matrix makes the same of both.
    for (name, from) in [("a", "slab.rd.zarr"), ("b", "s3://lab/slab.rd.zarr")] {
        done(run(&format!("factor {from} --terms 2 --out {name}.safetensors")));
        let made = done(run(&format!("evaluate a.safetensors {from} --json")));
        std::fs::write(folder.path().join(format!("{name}.json")), made).unwrap();
        done(run(&format!("import-matrix {from} --out {name}.rd.zarr")));
    }
    let read = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
    assert!(read("a.safetensors") == read("b.safetensors"));
    let figures = |name: &str| -> serde_json::Value {
        let mut all: serde_json::Value = serde_json::from_slice(&read(name)).unwrap();
        all.as_object_mut().unwrap().retain(|_, value| value.is_number());
        all
    };
    assert_eq!(figures("a.json"), figures("b.json"));
    let chunks = |name: &str| common::files(&folder.path().join(name).join("response"));
    assert_eq!(chunks("a.rd.zarr"), chunks("b.rd.zarr"));
    // Nothing is replaced that is not to be.
    let again = format!("build-matrix {captures} --out s3://lab/slab.rd.zarr");
    refused(run(&again), &["s3://lab/slab.rd.zarr", "--force"]);
    done(run(&format!("{again} --force")));
    s3.put("slab.rd.zarr/notes.txt", &[]);
    refused(run(&format!("{again} --force")), &["s3://lab/slab.rd.zarr/notes.txt"]);
    s3.ask("DELETE", "slab.rd.zarr/notes.txt");
    // A chunk that is gone, and a store that is not finished.
    s3.ask("DELETE", CHUNK);
    refused(
        run("factor s3://lab/slab.rd.zarr"),
        &["s3://lab/slab.rd.zarr", "array response: chunk c.1.0.0.0.0 is missing"],
    );
    s3.ask("DELETE", "slab.rd.zarr/zarr.json");
    refused(run("factor s3://lab/slab.rd.zarr"), &["a Zarr group", "no zarr.json"]);
}

/// The example's capture and rig, file by file, by their names below the project.
fn example() -> Vec<(String, Vec<u8>)> {
    let project = Path::new(env!("CARGO_MANIFEST_DIR"));
    let files = |folder: &'static str| {
        common::files(&project.join(folder)).into_iter().map(move |(name, bytes)| (format!("{folder}/{name}"), bytes))
    };
    files("captures").chain(files("calibration")).collect()
}

#[test]
fn a_capture_in_an_object_store_gives_the_matrix_that_it_gives_in_a_folder() {
    let Some(s3) = S3::start() else { return };
    let folder = tempfile::tempdir().unwrap();
    let run = |line: &str| s3.acquire(folder.path(), line);
    let captures = Path::new(env!("CARGO_MANIFEST_DIR")).join("captures");
    let files = example();
    files.iter().for_each(|(name, bytes)| s3.put(name, bytes));
    let matrix = |name: &str| common::files(&folder.path().join(name));
    done(run(&format!("build-matrix {} --out here.rd.zarr", captures.display())));
    done(run("build-matrix s3://lab/captures --out there.rd.zarr"));
    assert!(matrix("here.rd.zarr") == matrix("there.rd.zarr"));
    let findings = |capture: &str| {
        let told: serde_json::Value = serde_json::from_str(&done(run(&format!("check {capture} --json")))).unwrap();
        told["findings"].clone()
    };
    assert_eq!(findings("s3://lab/captures/"), findings(&captures.display().to_string()));
    // By tasks. A photograph that was written again, with the same bytes, is read again and is the same one.
    let (photograph, bytes) = files.iter().find(|(name, _)| name.contains("lattice")).unwrap();
    done(run("prepare s3://lab/captures --out common.prepared"));
    std::fs::create_dir(folder.path().join("parts")).unwrap();
    for part in ["1", "2"] {
        done(run(&format!("extract common.prepared --part {part}/2 --out parts/{part}.part")));
    }
    std::thread::sleep(Duration::from_millis(1100)); // the store's clock counts seconds
    s3.put(photograph, bytes);
    done(run("assemble s3://lab/captures parts --out parts.rd.zarr"));
    assert!(matrix("here.rd.zarr") == matrix("parts.rd.zarr"));
    refused(run("build-matrix s3://lab/captures --out s3://lab --force"), &["holds the input s3://lab/captures"]);
    refused(run("build-matrix s3://lab/captures --out s3://lab/captures/calibration/x"), &["lies in the input"]);
    // Cut, of no bytes, not there; no capture; no rig.
    let url = format!("s3://lab/{photograph}");
    for cut in [bytes.len() / 2, 0] {
        s3.put(photograph, &bytes[..cut]);
        refused(run("build-matrix s3://lab/captures --out x.rd.zarr"), &[&url]);
    }
    s3.ask("DELETE", photograph);
    refused(run("build-matrix s3://lab/captures --out x.rd.zarr"), &[&url, "missing"]);
    refused(run("build-matrix s3://lab/nothing --out x.rd.zarr"), &["s3://lab/nothing: no capture.toml"]);
    s3.ask("DELETE", "calibration/rig.toml");
    refused(run("check s3://lab/captures"), &["s3://lab/captures/calibration, s3://lab/calibration"]);
    assert!(!folder.path().join("x.rd.zarr").exists());
}

#[test]
fn a_server_that_does_not_answer_is_asked_again_and_then_named() {
    let Some(mut s3) = S3::start() else { return };
    let folder = tempfile::tempdir().unwrap();
    s3.server.kill().unwrap();
    s3.server.wait().unwrap();
    let start = Instant::now();
    let answer = s3.acquire(folder.path(), "factor s3://lab/slab.rd.zarr");
    refused(answer, &["s3://lab/slab.rd.zarr", "object slab.rd.zarr/zarr.json", "8 retries"]);
    // Pauses are drawn between 0.1 s and twice the one before, so that they are 0.8 s in all at least.
    assert!(start.elapsed() > Duration::from_millis(800));
}

/// Answers GET and HEAD with a folder's files, whole or in part; every third connection is closed without an answer.
fn serve(root: std::path::PathBuf, listener: TcpListener) {
    for (k, stream) in listener.incoming().enumerate() {
        let Ok(mut stream) = stream else { return };
        let mut head = Vec::new();
        let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
        while let Some(Ok(line)) = lines.next().filter(|line| line.as_ref().is_ok_and(|line| !line.is_empty())) {
            head.push(line);
        }
        let Some(first) = head.first().filter(|_| k % 3 != 2) else { continue };
        let mut words = first.split(' ');
        let (method, path) = (words.next().unwrap(), words.next().unwrap());
        let Ok(bytes) = std::fs::read(root.join(path.trim_start_matches('/'))) else {
            let _ = stream.write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
            continue;
        };
        let range = head.iter().find_map(|l| l.to_ascii_lowercase().strip_prefix("range: bytes=").map(str::to_owned));
        let all = bytes.len();
        let (from, to) = match range.as_deref().and_then(|r| r.split_once('-')) {
            None => (0, all),
            Some(("", last)) => (all - last.parse::<usize>().unwrap().min(all), all),
            Some((from, last)) => (from.parse().unwrap(), last.parse::<usize>().map_or(all, |last| all.min(last + 1))),
        };
        let status = match range {
            Some(_) => format!("206 Partial Content\r\nContent-Range: bytes {from}-{}/{all}", to - 1),
            None => "200 OK".into(),
        };
        let head = format!(
            "HTTP/1.1 {status}\r\nContent-Length: {}\r\nLast-Modified: Tue, 01 Dec 2026 00:00:00 GMT\r\nConnection: close\r\n\r\n",
            to - from
        );
        let body = if method == "HEAD" { &[][..] } else { &bytes[from..to] };
        let _ = stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(body));
    }
}

#[test]
fn a_matrix_is_read_from_a_plain_server_whose_connections_break() {
    let folder = tempfile::tempdir().unwrap();
    let run = |line: &str| common::outcome(&mut common::command_in(folder.path(), line));
    let captures = Path::new(env!("CARGO_MANIFEST_DIR")).join("captures");
    done(run(&format!("build-matrix {} --out slab.rd.zarr", captures.display())));
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://127.0.0.1:{}/slab.rd.zarr", listener.local_addr().unwrap().port());
    let root = folder.path().to_path_buf();
    std::thread::spawn(move || serve(root, listener));
    for (name, from) in [("a", "slab.rd.zarr"), ("b", &url)] {
        done(run(&format!("factor {from} --terms 2 --out {name}.safetensors")));
    }
    let read = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
    assert!(read("a.safetensors") == read("b.safetensors"));
    refused(run(&format!("build-matrix {} --out {url}", captures.display())), &["read only", &url]);
    std::fs::remove_file(folder.path().join("slab.rd.zarr/response/c.0.0.0.0.0")).unwrap();
    refused(run(&format!("factor {url}")), &[&url, "array response: chunk c.0.0.0.0.0 is missing"]);
}

#[test]
fn a_capture_is_read_from_a_plain_server_whose_connections_break() {
    let folder = tempfile::tempdir().unwrap();
    let project = Path::new(env!("CARGO_MANIFEST_DIR")).to_path_buf();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let captures = project.join("captures").display().to_string();
    std::thread::spawn(move || serve(project, listener));
    let url = format!("http://127.0.0.1:{port}/captures");
    for (name, from) in [("here", &captures), ("there", &url)] {
        done(common::outcome(&mut common::command_in(folder.path(), &format!("build-matrix {from} --out {name}"))));
    }
    assert!(common::files(&folder.path().join("here")) == common::files(&folder.path().join("there")));
}
