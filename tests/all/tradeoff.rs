//! The trade-off on a small matrix, through the library and through the program.

use crate::matrices::{profile, write};
use acquire::material::{Model, Precision};
use acquire::progress::Progress;
use acquire::tradeoff::{TradeoffOptions, csv, html, tradeoff};
use std::process::Command;

fn response(i: usize, d: [f64; 2], c: usize) -> f32 {
    let (a, b) = ((i % 30) as f64 / 30.0, (i / 30) as f64 / 30.0);
    ((1.2 - a) * profile(d, 1.0 + b) + a * profile(d, 3.0)).powf([0.9, 1.0, 1.15][c] + 0.1 * (a - b)) as f32
}

#[test]
#[ignore = "slow: 10 s"]
fn every_point_is_measured_and_the_front_is_never_beaten() {
    let folder = tempfile::tempdir().unwrap();
    let reader = write(&folder.path().join("m.rd.zarr"), [30, 26], [9, 9], |_, _| 0.0, 0.0, response).unwrap();
    let found = tradeoff(&reader, &TradeoffOptions { quick: true, memory_bytes: None }, &Progress::silent()).unwrap();
    assert_eq!((found.points_looked_at, found.points), ([24, 24], [30, 26]));
    for model in [Model::Joint, Model::Tucker, Model::Peers2006] {
        assert!(found.measured.iter().any(|p| p.model == model));
    }
    for precision in [Precision::F32, Precision::F16, Precision::Coded] {
        assert!(found.measured.iter().any(|p| p.precision == precision));
    }
    let joint = |terms| {
        let of = |p: &&acquire::tradeoff::TradePoint| {
            p.model == Model::Joint && p.terms == terms && p.precision == Precision::F32
        };
        found.measured.iter().find(of).unwrap().psnr_db.unwrap()
    };
    assert!(joint(4) > joint(1) && joint(8) > joint(4), "more terms are better");
    let front: Vec<_> = found.measured.iter().filter(|p| p.pareto).collect();
    assert!(front.len() > 3);
    for p in &front {
        let better = |q: &&acquire::tradeoff::TradePoint| q.bytes < p.bytes && q.psnr_db > p.psnr_db;
        assert!(!found.measured.iter().any(|q| better(&q)), "{p:?}");
    }
    assert_eq!(found.regression_conditions.len(), 16);
    assert!(
        found.regression_conditions.windows(2).all(|w| w[1][0] >= 0.99 * w[0][0]),
        "conditions grow with the degree"
    );
    assert_eq!(csv(&found).lines().count(), found.measured.len() + 1);
    let page = html(&found);
    assert_eq!(page.matches("<svg").count(), 2);
    // Opens without a network: names of vocabularies are no addresses that anything is fetched from.
    assert!(!page.replace("http://www.w3.org/2000/svg", "").contains("http"));
}

#[test]
fn the_program_writes_a_page_and_replaces_none_unasked() {
    let folder = tempfile::tempdir().unwrap();
    let matrix = folder.path().join("m.rd.zarr");
    write(&matrix, [8, 8], [7, 7], |_, _| 0.0, 0.0, response).unwrap();
    let out = folder.path().join("t");
    let run = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_acquire"));
        command.arg("tradeoff").arg(&matrix).arg("--out").arg(&out).args(args).output().unwrap()
    };
    let first = run(&["--quick", "--json"]);
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    let json: serde_json::Value = serde_json::from_slice(&first.stdout).unwrap();
    assert!(json["measured"].as_array().is_some_and(|all| all.len() > 20));
    for name in ["tradeoff.html", "tradeoff.csv", "tradeoff.json"] {
        assert!(out.join(name).is_file(), "{name}");
    }
    let again = run(&["--quick"]);
    assert_eq!(again.status.code(), Some(1), "an earlier result is not replaced unasked");
}
