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
    let reader = write(&folder.path().join("m.rd.zarr"), [30, 26], [9, 9], |_, _| 1e-8, 0.0, response).unwrap();
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
    let defaults: Vec<Precision> = found.measured.iter().filter(|p| p.default).map(|p| p.precision).collect();
    assert_eq!(defaults, [Precision::F32, Precision::Coded]);
    let recommended: Vec<_> = found.measured.iter().filter(|p| p.recommended).collect();
    let default = found.measured.iter().find(|p| p.default).unwrap();
    assert!(recommended.len() == 1 && recommended[0].bytes <= default.bytes, "{recommended:?}");
    // Of the 24 × 24 points in the middle, with a standard deviation of 1e-4 everywhere.
    let middle = (0..780).filter(|i| (3..27).contains(&(i % 30)) && (1..25).contains(&(i / 30)));
    let offsets = || (0..81).map(|k| [(k % 9) as f64 - 4.0, (k / 9) as f64 - 4.0]);
    let entries = middle.flat_map(|i| offsets().flat_map(move |d| (0..3).map(move |c| f64::from(response(i, d, c)))));
    let expected = (1e-8 / (entries.map(|r| r * r).sum::<f64>() / (576.0 * 243.0))).sqrt();
    let noise = found.noise.unwrap();
    assert!((noise.rel_rmse / expected - 1.0).abs() < 1e-5, "f32: {noise:?} {expected}");
    assert_eq!(found.regression_conditions.len(), 16);
    assert!(
        found.regression_conditions.windows(2).all(|w| w[1][0] >= 0.99 * w[0][0]),
        "conditions grow with the degree"
    );
    assert!(found.measured.iter().all(|p| p.log_rmse.is_some()), "tails of every point, coded ones too");
    assert_eq!(csv(&found).lines().count(), found.measured.len() + 1);
    let page = html(&found);
    for words in ["default, plain", "default, coded", "recommended", "noise, "] {
        assert!(page.contains(words), "{words}");
    }
    assert_eq!(page.matches("<svg").count(), 3);
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
