//! The transport solver against an analytic solution, and the laws that it must keep.

use super::beam::Beam;
use super::domain::{Domain, SolverSlab};
use super::field::Field;
use super::multigrid::{Columns, Multigrid};
use super::solution::Balance;
use crate::geometry::Point;
use crate::simulate::slab::layout::{SlabPlace, build};
use crate::simulate::slab::{SlabMaterial, Volume, boundary_factor, normal_reflectance};
use crate::simulate::{FileFormat, SimulateOptions, bench::Bench};
use std::f64::consts::PI;

const THICKNESS_MM: f64 = 4.0;
/// Projector px on the slab, mm, and the dot's side, px.
const PX_MM: f64 = 0.125;
const DOT_PX: usize = 3;
const BLUR_PX: f64 = 0.3;

/// The slab of diffusion alone, without flights before it.
fn slab(material: SlabMaterial, voxel_mm: f64) -> SolverSlab {
    let place = SlabPlace { lit_origin_mm: [-8.0; 2], lit_size_mm: [16.0; 2], size_mm: [16.0; 2] };
    let options = SimulateOptions { material, thickness_mm: Some(THICKNESS_MM), ..SimulateOptions::default() };
    SolverSlab { flights: 0, ..SolverSlab::new(build(&options, &place).unwrap().volume, voxel_mm, 1e-6) }
}

fn domain(voxel_mm: f64, voxels: usize, center: Point) -> Domain {
    Domain { corner_mm: center.map(|c| c - 0.5 * voxels as f64 * voxel_mm), voxel_mm, voxels: [voxels; 2] }
}

/// The exitance of a dot at `center`, red in all channels, and where its light went.
fn respond(slab: &SolverSlab, domain: &Domain, center: Point) -> (Field, Balance) {
    let mm_from_px = [[PX_MM, 0.0], [0.0, PX_MM]];
    let flux = Beam { center_mm: center, mm_from_px, side_px: DOT_PX as f64, round: false, blur_px: BLUR_PX }
        .footprint(domain);
    let solution = slab.solve(domain, &flux, 0).unwrap();
    let exitance = solution.exitance();
    let field = Field::interpolate(domain.corner_mm, domain.voxel_mm, domain.voxels, [&exitance; 3]);
    (field, solution.balance())
}

/// The same slab by Hankel transform: the one-dimensional problem of each radial frequency has a closed form.
///
/// −Dφ'' + (σ_a + Dk²)φ = q(z), φ = z_b φ' on top, φ = −z_b φ' below (z_b = 2AD). With u(z) = sinh λz + z_b λ cosh λz
/// and λ² = k² + σ_a/D, a source at z' sends u(d − z')/(u(d) + z_b u'(d)) of itself out through the top. Depths and
/// frequencies are summed by the midpoint rule; the square dot is a Gaussian of its second moment.
fn analytic_exitance(volume: &Volume, radii_mm: &[f64]) -> Vec<f64> {
    let optics = volume.optics[0];
    let (scattering, absorption) = (optics.reduced_scattering_per_mm[0], optics.absorption_per_mm[0]);
    let extinction = scattering + absorption;
    let diffusion = 1.0 / (3.0 * extinction);
    let z_b = 2.0 * boundary_factor(volume.refractive_index) * diffusion;
    let enters = 1.0 - normal_reflectance(volume.refractive_index);
    let (depths, frequencies, step) = (400, 4000, 0.01);
    let dz = THICKNESS_MM / f64::from(depths);
    let side = DOT_PX as f64 * PX_MM;
    let variance = side * side / 12.0 + (BLUR_PX * PX_MM).powi(2);
    let mut sums = vec![0.0; radii_mm.len()];
    for n in 0..frequencies {
        let k = (f64::from(n) + 0.5) * step;
        let lambda = (k * k + absorption / diffusion).sqrt();
        // u and u' over e^(λd)/2, so that nothing overflows.
        let u = |z: f64| {
            let (grow, decay) = ((lambda * (z - THICKNESS_MM)).exp(), (-lambda * (z + THICKNESS_MM)).exp());
            (grow - decay) + z_b * lambda * (grow + decay)
        };
        let decay = (-2.0 * lambda * THICKNESS_MM).exp();
        let slope = lambda * (1.0 + decay) + z_b * lambda * lambda * (1.0 - decay);
        let leaves = (0..depths).map(|i| {
            let z = (f64::from(i) + 0.5) * dz;
            enters * scattering * (-extinction * z).exp() * dz * u(THICKNESS_MM - z)
        });
        let spectrum = leaves.sum::<f64>() / (u(THICKNESS_MM) + z_b * slope) * (-0.5 * k * k * variance).exp();
        for (sum, r) in sums.iter_mut().zip(radii_mm) {
            *sum += spectrum * bessel_j0(k * r) * k * step / (2.0 * PI);
        }
    }
    sums
}

/// J₀ by its integral; the trapezoidal rule converges geometrically once it has more points than x.
fn bessel_j0(x: f64) -> f64 {
    let n = 24 + x as usize;
    (0..n).map(|i| (x * (PI * (i as f64 + 0.5) / n as f64).sin()).cos()).sum::<f64>() / n as f64
}

/// Largest relative error along x at 1, 1.5, … 4 mm.
fn analytic_error(voxel_mm: f64, voxels: usize) -> f64 {
    let slab = slab(SlabMaterial::homogeneous(), voxel_mm);
    let (field, _) = respond(&slab, &domain(voxel_mm, voxels, [0.0, 0.0]), [0.0, 0.0]);
    let radii: Vec<f64> = (2..=8).map(|i| 0.5 * f64::from(i)).collect();
    let exact = analytic_exitance(&slab.volume, &radii);
    let errors = radii.iter().zip(&exact).map(|(&r, e)| (f64::from(field.at([r, 0.0])[0]) / e - 1.0).abs());
    errors.fold(0.0, f64::max)
}

#[test]
fn a_homogeneous_slab_agrees_with_the_analytic_solution_and_refinement_converges() {
    let (default, fine) = (analytic_error(0.25, 80), analytic_error(0.125, 160));
    println!("relative error against the Hankel solution: {default:.4} at 0.25 mm, {fine:.4} at 0.125 mm");
    assert!(default < 0.02 && fine < 0.008, "{default} {fine}");
    assert!(fine < 0.5 * default);
}

#[test]
fn the_sides_of_the_box_do_not_shape_the_window() {
    let slab = slab(SlabMaterial::homogeneous(), 0.25);
    let (small, _) = respond(&slab, &domain(0.25, 48, [0.0, 0.0]), [0.0, 0.0]);
    let (large, _) = respond(&slab, &domain(0.25, 128, [0.0, 0.0]), [0.0, 0.0]);
    let (a, b) = (small.cell_means([0.0; 2], [15, 15], 0.5), large.cell_means([0.0; 2], [15, 15], 0.5));
    let worst = a.iter().zip(&b).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f32::max);
    println!("largest relative change of a window of 15 when its box grows: {worst:.4}");
    // Four pitches of margin: the corner cells feel the box by under 2 %, at 2e-3 of the peak.
    assert!(worst < 0.02, "{worst}");
}

#[test]
fn energy_balances() {
    for material in [SlabMaterial::homogeneous(), SlabMaterial::chessboard([4, 3]), SlabMaterial::marble()] {
        for flights in [0, 2] {
            let slab = SolverSlab { flights, ..slab(material.clone(), 0.25) };
            let (_, b) = respond(&slab, &domain(0.25, 64, [0.7, -0.3]), [0.7, -0.3]);
            let spent = b.spent();
            // The residual's sum: the solver's tolerance (1e-6, Euclidean) times the root of the voxels it may add up
            // over.
            assert!((spent / b.source - 1.0).abs() < 2e-5, "{material:?}, {flights}: {spent} of {}", b.source);
            let most = 1.0 - normal_reflectance(slab.volume.refractive_index);
            assert!(b.source < most && b.source > 0.9 * most);
        }
    }
}

/// A point source in one voxel is seen in another as the other way round: the operator is symmetric, across edges of
/// materials too. (R_d itself need not be: its source spreads along depth, its detector is the surface.)
#[test]
fn point_sources_and_detectors_are_reciprocal() {
    let (nx, ny, layers) = (24, 24, [0.1, 0.2, 0.3, 0.4]);
    let wobble = |i: usize| 1.0 + 0.9 * ((i * 7919 % 101) as f32 / 101.0 - 0.5);
    let map = |f: &dyn Fn(usize) -> f32| (0..nx * ny).map(f).collect::<Vec<f32>>();
    let columns = Columns {
        nx,
        ny,
        west: map(&|i| if i % nx == 0 { 0.0 } else { wobble(i) }),
        north: map(&|i| if i < nx { 0.0 } else { wobble(i + 3) }),
        loss: map(&|i| 0.01 * wobble(i + 5)),
        vertical: map(&|i| 0.05 * wobble(i + 8)),
        top: map(&|i| 0.02 * wobble(i + 13)),
        bottom: map(&|i| 0.02 * wobble(i + 21)),
    };
    let mut multigrid = Multigrid::new(columns, &layers);
    let (a, b) = (5 * nx + 7, nx * ny + 14 * nx + 12);
    let mut seen = |from: usize, at: usize| {
        let mut source = multigrid.zeros();
        multigrid.voxels_mut(&mut source)[from] = 1.0;
        let (x, convergence) = multigrid.solve(&source, 1e-6, 60);
        assert!(convergence.iterations < 20, "{convergence:?}");
        multigrid.voxels(&x)[at]
    };
    let (there, back) = (seen(a, b), seen(b, a));
    assert!(there > 0.0 && (there / back - 1.0).abs() < 1e-3, "{there} {back}");
}

#[test]
fn the_response_moves_with_its_dot() {
    let options = SimulateOptions {
        grid: [5, 4],
        window: [11, 7],
        material: SlabMaterial::homogeneous(),
        ..SimulateOptions::default()
    };
    let bench = Bench::new(&options, &crate::progress::Progress::silent()).unwrap();
    let means = |drift: Point| {
        let field = bench.glow([1, 2], drift).unwrap();
        field.cell_means(bench.scene.dot_mm([1, 2], drift), [9, 9], options.pitch_mm)
    };
    let still = means([0.0, 0.0]);
    for drift in [[0.013, 0.0], [0.1, -0.07], [0.125, 0.125]] {
        // Homogeneous: the window goes with the dot, but is seen from a little aside: a thousandth of the distance to
        // the eye turns the view by as much, and shifts light from 1 mm deep by 1 µm where the window changes by up to
        // 5 per mm.
        let worst = still.iter().zip(means(drift)).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f32::max);
        println!("{drift:?}: {worst:.1e}");
        assert!(worst < 1e-2, "{drift:?}: {worst}");
    }
    // Over a chessboard of 1 mm squares, towards an edge, the peak changes smoothly: second differences stay small.
    let options = SimulateOptions { material: SlabMaterial::chessboard([8, 6]), grid: [18, 14], ..options };
    let bench = Bench::new(&options, &crate::progress::Progress::silent()).unwrap();
    let peak = |x: f64| {
        let field = bench.glow([1, 2], [x, 0.0]).unwrap();
        f64::from(field.cell_means(bench.scene.dot_mm([1, 2], [x, 0.0]), [1, 1], options.pitch_mm)[0])
    };
    let steps: Vec<f64> = (0..9).map(|i| peak(0.02 * f64::from(i))).collect();
    for triple in steps.windows(3) {
        let bend = (triple[2] - 2.0 * triple[1] + triple[0]).abs();
        // Diffusion alone bends by less than half of this; the rest is the flights' fixed rays meeting other voxels.
        assert!(bend < 4e-3 * triple[1], "{bend} {steps:?}");
    }
}

#[test]
fn defaults_are_sound_and_bad_options_are_named() {
    SimulateOptions::default().check().unwrap();
    let even = SimulateOptions { window: [9, 8], ..SimulateOptions::default() };
    assert!(even.check().unwrap_err().to_string().contains("window"));
    let wide = SimulateOptions { dot_projector_px: 9, ..SimulateOptions::default() };
    assert!(wide.check().unwrap_err().to_string().contains("dot_projector_px"));
    assert_eq!(SimulateOptions { window: [31, 11], ..SimulateOptions::default() }.spacing(), [47, 20]);
    let sideways = SimulateOptions { window: [31, 11], projector_turn_deg: -80.0, ..SimulateOptions::default() };
    // 46.5 samples along the projector's y, whose dots are 1.25 samples apart.
    assert_eq!(sideways.spacing(), [24, 38]);
    let text = toml::to_string(&SimulateOptions { format: FileFormat::Jpeg, ..SimulateOptions::default() }).unwrap();
    assert_eq!(toml::from_str::<SimulateOptions>(&text).unwrap().format, FileFormat::Jpeg);
}
