//! The transport solvers: photons per second, and diffusion against Monte Carlo.
//!
//! `cargo bench --bench transport` prints photons per second on one thread and on all, for the slabs that
//! benches/peers/photons/ runs through other codes; medians of five. `cargo bench --bench transport -- materials
//! [PHOTONS]` prints what diffusion costs in accuracy and saves in time, per material: the truth of a simulated capture
//! by diffusion against that by Monte Carlo (2 × 2 points, 31 × 31 window).

use acquire::evaluate::evaluate;
use acquire::material::Source;
use acquire::progress::Progress;
use acquire::simulate::monte_carlo::{self, Medium, Setup, TallyWindow};
use acquire::simulate::{Cause, Optics, SimulateOptions, TRUTH_MATRIX, Transport, Volume, simulate};
use acquire::transport::MatrixReader;
use std::time::Instant;

type Layer = (Optics, f64);

/// In the units of the papers: µa, µs in cm⁻¹, g, thickness in cm.
fn layer(absorption_per_cm: f64, scattering_per_cm: f64, g: f64, thickness_cm: f64) -> Layer {
    let optics = Optics {
        reduced_scattering_per_mm: [0.1 * scattering_per_cm * (1.0 - g); 3],
        absorption_per_mm: [0.1 * absorption_per_cm; 3],
        anisotropy: [g; 3],
    };
    (optics, 10.0 * thickness_cm)
}

fn main() -> acquire::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    match arguments.first().map(String::as_str) {
        Some("materials") => materials(arguments.get(1).and_then(|n| n.parse().ok()).unwrap_or(1e6) as u64),
        _ => photons(),
    }
}

fn photons() -> acquire::Result<()> {
    let slabs = [
        ("a  van de Hulst, n 1", 4e6, 1.0, vec![layer(10.0, 90.0, 0.75, 0.02)]),
        (
            "b  three layers",
            4e5,
            1.37,
            vec![layer(1.0, 100.0, 0.9, 0.1), layer(1.0, 10.0, 0.0, 0.1), layer(2.0, 10.0, 0.7, 0.2)],
        ),
        ("c  marble green, 5 mm", 4e5, 1.5, vec![layer(0.041, 26.2, 0.0, 0.5)]),
    ];
    println!("{:<24} {:>14} {:>14} {:>22}", "photons per second", "one thread", "all threads", "with a camera, one");
    for (name, photons, n, layers) in slabs {
        let medium = Medium::new(&Volume::layered(&layers, n), 0);
        let totals = Setup::totals(&medium);
        let window = Some(TallyWindow { corner_mm: [-10.0; 2], cell_mm: 0.125, cells: [160; 2] });
        let camera = Setup { window, eye_mm: Some([5.0, 0.0, -100.0]), ..totals };
        let rate = |setup: &Setup, threads: usize| -> acquire::Result<f64> {
            let pool =
                rayon::ThreadPoolBuilder::new().num_threads(threads).build().map_err(acquire::Error::internal)?;
            let mut rates = Vec::new();
            for seed in 0..5 {
                let options = monte_carlo::TraceOptions { photons: photons as u64, seed };
                let start = Instant::now();
                pool.install(|| monte_carlo::trace(setup, &options, None))?;
                rates.push(photons / start.elapsed().as_secs_f64());
            }
            rates.sort_by(f64::total_cmp);
            Ok(rates[2])
        };
        println!("{name:<24} {:>14.3e} {:>14.3e} {:>22.3e}", rate(&totals, 1)?, rate(&totals, 0)?, rate(&camera, 1)?);
    }
    Ok(())
}

fn materials(photons: u64) -> acquire::Result<()> {
    let named = "homogeneous:cream homogeneous:spectralon homogeneous:whole-milk homogeneous:marble homogeneous:apple \
                 homogeneous:skim-milk homogeneous:skin2 homogeneous:potato homogeneous:skin1 homogeneous:chicken2 \
                 homogeneous:chicken1 homogeneous:ketchup chessboard-4x4 chessboard-8x8 marble layered nearly-opaque nearly-clear lossless";
    let folder = tempfile::tempdir().map_err(acquire::Error::io("create", "a temporary folder"))?;
    println!("| material | rel_rmse | log_rmse | photon noise | diffusion, s | Monte Carlo, s | ratio |");
    println!("|---|---|---|---|---|---|---|");
    let figure = |v: Option<f64>| v.map_or("–".to_owned(), |v| format!("{v:.4}"));
    for material in named.split_whitespace() {
        let mut times = Vec::new();
        let mut noise = 0.0;
        let path = |transport| folder.path().join(format!("{transport:?}"));
        for transport in [Transport::Diffusion, Transport::Mc] {
            let mut options = SimulateOptions {
                transport,
                photons,
                grid: [2, 3],
                window: [33, 29],
                force: true,
                ..SimulateOptions::default()
            };
            options.material = material.parse().map_err(|_| acquire::Error::internal(material))?;
            options.exposures = 1;
            options.only(&[Cause::Drift]);
            let start = Instant::now();
            noise = simulate(&options, &path(transport), &Progress::silent())?.photon_noise.unwrap_or(0.0);
            times.push(start.elapsed().as_secs_f64());
        }
        let truth = |transport| path(transport).join(TRUTH_MATRIX);
        let reference = MatrixReader::open(&truth(Transport::Mc))?;
        let measures = evaluate(&Source::open(&truth(Transport::Diffusion))?, &reference, &Progress::silent())?;
        println!(
            "| {material} | {} | {} | {noise:.4} | {:.2} | {:.2} | {:.0} |",
            figure(measures.rel_rmse),
            figure(measures.log_rmse),
            times[0],
            times[1],
            times[1] / times[0]
        );
    }
    Ok(())
}
