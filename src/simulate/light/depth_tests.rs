//! Slabs whose coefficients vary with depth, and slabs at the ends of every range.

use super::domain::layers_mm;
use super::domain::{Domain, SolverSlab};
use super::multigrid::{Columns, Multigrid};
use crate::simulate::slab::{Beyond, Optics, Volume, boundary_factor, normal_reflectance, table};

fn optics(scattering: f64, absorption: f64) -> Optics {
    Optics { reduced_scattering_per_mm: [scattering; 3], absorption_per_mm: [absorption; 3], anisotropy: [0.0; 3] }
}

fn domain(voxel_mm: f64, voxels: usize) -> Domain {
    Domain { corner_mm: [-0.5 * voxels as f64 * voxel_mm; 2], voxel_mm, voxels: [voxels; 2] }
}

/// The exitance of light that falls on four columns in the middle, and where it went, relative to the source.
fn solve(volume: &Volume, domain: &Domain, channel: usize) -> (Vec<f32>, f64) {
    // Diffusion alone: what it is compared with has no flights before it.
    let slab = SolverSlab { flights: 0, ..SolverSlab::new(volume.clone(), domain.voxel_mm, 1e-6) };
    let mut flux = vec![0.0; domain.columns()];
    let [nx, ny] = domain.voxels;
    for i in [0, 1, nx, nx + 1] {
        flux[(ny / 2 - 1) * nx + nx / 2 - 1 + i] = 0.25;
    }
    let solution = slab.solve(domain, &flux, channel).unwrap();
    let balance = solution.balance();
    (solution.exitance(), if balance.source == 0.0 { 1.0 } else { balance.spent() / balance.source })
}

/// Numbers in 0..1 that look random, the same every time.
fn wobble(i: usize) -> f64 {
    (i * 7919 % 10_007) as f64 / 10_007.0
}

/// Voxels of 0.3 × 0.4 × 0.25 mm, from whole milk to a hundredth of it, and as varied in absorption.
fn random_voxels() -> Volume {
    let [nx, ny, nz] = [20, 15, 16];
    let medium = |i: usize| optics(2.55 * 0.01f64.powf(wobble(i)), 0.001 * 1000f64.powf(wobble(i + 5)));
    Volume {
        origin_mm: [-3.0; 2],
        voxel_mm: [0.3, 0.4],
        voxels: [nx, ny],
        layers_mm: vec![0.25; nz],
        beyond: Beyond::Extend,
        optics: (0..nx * ny * nz).map(medium).collect(),
        ..Volume::uniform(optics(1.0, 0.0), 1.4, 4.0)
    }
}

fn skin_on_milk() -> Volume {
    Volume::layered(&[(optics(0.74, 0.032), 0.5), (optics(2.55, 0.0011), 1.7), (optics(0.18, 0.061), 1.8)], 1.3)
}

/// Milk over milk in three parts: the same as one, to the rounding of f32 sums.
#[test]
fn equal_layers_are_one_slab() {
    let milk = optics(2.55, 0.0011);
    let one = solve(&Volume::uniform(milk, 1.3, 4.0), &domain(0.25, 48), 0).0;
    let three = solve(&Volume::layered(&[(milk, 1.0), (milk, 2.0), (milk, 1.0)], 1.3), &domain(0.25, 48), 0).0;
    assert_eq!(one, three);
    // Where one voxel far away forbids to join the layers, the maps per layer are used: a different sum, the same slab.
    let mut deep = Volume { voxels: [2, 1], voxel_mm: [100.0, 100.0], ..Volume::uniform(milk, 1.3, 4.0) };
    (deep.layers_mm, deep.optics) = (vec![4.0 - 0.1, 0.1], vec![milk, milk, milk, optics(2.5, 0.0011)]);
    let slab = SolverSlab::new(deep, 0.25, 1e-6);
    let uniform = SolverSlab { volume: Volume::uniform(milk, 1.3, 4.0), ..slab.clone() };
    let domain = domain(0.25, 48);
    let flux: Vec<f64> = (0..48 * 48).map(|i| f64::from(u8::from(i == 24 * 48 + 24))).collect();
    let solve = |slab: &SolverSlab| slab.solve(&domain, &flux, 0).unwrap().exitance();
    let (maps, plane) = (solve(&slab), solve(&uniform));
    let largest = plane.iter().copied().fold(0.0, f32::max);
    let worst = maps.iter().zip(&plane).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    // The solver stops at 1e-6 of the first residual.
    assert!(worst < 2e-6 * largest, "{worst} of {largest}");
}

#[test]
fn energy_balances_whatever_varies_with_depth() {
    for (name, volume) in [("layers", skin_on_milk()), ("voxels", random_voxels())] {
        let spent = solve(&volume, &domain(0.25, 64), 0).1;
        println!("{name}: 1 {:+.1e} of the source is in the balance", spent - 1.0);
        // The residual's sum: the solver's tolerance (1e-6, Euclidean) times the root of the voxels it may add up over.
        assert!((spent - 1.0).abs() < 5e-5, "{name}: {spent}");
    }
}

/// As in a slab that does not vary: the operator is symmetric.
#[test]
fn point_sources_and_detectors_are_reciprocal_across_depth() {
    let (nx, ny, layers) = (24, 24, [0.1, 0.2, 0.3, 0.4]);
    let plane = nx * ny;
    let map = |f: &dyn Fn(usize) -> f64| (0..4 * plane).map(|i| f(i) as f32).collect::<Vec<f32>>();
    let jump = |i: usize| 0.01 * 1000f64.powf(wobble(i));
    let columns = Columns {
        nx,
        ny,
        west: map(&|i| if i % nx == 0 { 0.0 } else { jump(i) }),
        north: map(&|i| if i % plane < nx { 0.0 } else { jump(i + 3) }),
        loss: map(&|i| 0.01 * jump(i + 5)),
        vertical: map(&|i| 0.05 * jump(i + 8)),
        top: map(&|i| 0.02 * jump(i + 13))[..plane].to_vec(),
        bottom: map(&|i| 0.02 * jump(i + 21))[..plane].to_vec(),
    };
    let mut multigrid = Multigrid::new(columns, &layers);
    let mut seen = |from: usize, at: usize| {
        let mut source = multigrid.zeros();
        multigrid.voxels_mut(&mut source)[from] = 1.0;
        let (x, convergence) = multigrid.solve(&source, 1e-7, 200);
        assert!(convergence.iterations < 100, "{convergence:?}");
        multigrid.voxels(&x)[at]
    };
    for (a, b) in [(5 * nx + 7, plane + 9 * nx + 8), (plane + 3, 3 * plane + 2 * nx + 5)] {
        let (there, back) = (seen(a, b), seen(b, a));
        // f32 sums, far from the source where the field is small.
        assert!(there > 0.0 && (there / back - 1.0).abs() < 1e-3, "{there} {back}");
    }
}

/// A thin, dark layer on top must cost light; the same layer below a thick slab must hardly be seen.
#[test]
fn the_order_of_layers_is_seen() {
    let (milk, dark) = (optics(2.55, 0.0011), optics(1.0, 0.5));
    let total = |layers: &[(Optics, f64)]| -> f64 {
        let exitance = solve(&Volume::layered(layers, 1.3), &domain(0.25, 64), 0).0;
        exitance.iter().map(|&e| f64::from(e) * 0.0625).sum()
    };
    let plain = total(&[(milk, 4.5)]);
    let (above, below) = (total(&[(dark, 0.5), (milk, 4.0)]), total(&[(milk, 4.0), (dark, 0.5)]));
    println!("diffuse reflectance: milk {plain:.3}, dark layer below {below:.3}, above {above:.3}");
    assert!(above < 0.6 * plain && below > 0.9 * plain && below < plain, "{plain} {above} {below}");
}

/// What leaves through the top all over the slab, by 20,000 layers in f64: summed over the plane, the field obeys the
/// equation in depth alone.
fn reflectance_in_depth(layers: &[(Optics, f64)], refractive_index: f64) -> f64 {
    let n = 20_000;
    let thickness: f64 = layers.iter().map(|l| l.1).sum();
    let dz = thickness / n as f64;
    let volume = Volume::layered(layers, refractive_index);
    let at = |i: usize| volume.optics[volume.depth_shares(i as f64 * dz, (i as f64 + 1.0) * dz)[0].0];
    let (s, e): (Vec<f64>, Vec<f64>) =
        (0..n).map(|i| (at(i).reduced_scattering_per_mm[0], at(i).extinction_per_mm(0))).unzip();
    let d: Vec<f64> = e.iter().map(|e| 1.0 / (3.0 * e)).collect();
    let escape = |d: f64| 1.0 / (dz / (2.0 * d) + 2.0 * boundary_factor(refractive_index));
    let link: Vec<f64> = d.windows(2).map(|d| 2.0 / (dz / d[0] + dz / d[1])).collect();
    let (mut diagonal, mut right) = (vec![0.0; n], vec![0.0; n]);
    let mut remains = 1.0 - normal_reflectance(refractive_index);
    for i in 0..n {
        let after = remains * (-e[i] * dz).exp();
        right[i] = s[i] / e[i] * (remains - after);
        remains = after;
        diagonal[i] = (e[i] - s[i]) * dz + if i > 0 { link[i - 1] } else { escape(d[0]) };
        diagonal[i] += if i + 1 < n { link[i] } else { escape(d[n - 1]) };
    }
    // Elimination from below leaves the top's fluence.
    for i in (0..n - 1).rev() {
        diagonal[i] -= link[i] * link[i] / diagonal[i + 1];
        right[i] += right[i + 1] * link[i] / diagonal[i + 1];
    }
    right[0] / diagonal[0] * escape(d[0])
}

#[test]
fn all_that_leaves_agrees_with_the_equation_in_depth() {
    let medium = |name: &str| table::medium(name).unwrap().optics;
    let (opaque, cream) = (medium("nearly-opaque"), medium("cream"));
    let layered = [(medium("skin1"), 0.5), (medium("whole-milk"), 1.7), (medium("ketchup"), 1.8)];
    for (name, layers, voxel_mm) in [
        ("nearly-opaque", &[(opaque, 4.0)][..], 0.25),
        ("nearly-opaque, coarse", &[(opaque, 4.0)], 1.0),
        ("cream", &[(cream, 4.0)], 0.25),
        ("cream, thin", &[(cream, 0.3)], 0.25),
        ("skin on milk on ketchup", &layered, 0.5),
        ("ketchup on milk", &[(medium("ketchup"), 1.0), (medium("whole-milk"), 3.0)], 0.5),
    ] {
        let exitance = solve(&Volume::layered(layers, 1.3), &domain(voxel_mm, 96), 0).0;
        let total = exitance.iter().map(|&e| f64::from(e)).sum::<f64>() * voxel_mm * voxel_mm;
        let exact = reflectance_in_depth(layers, 1.3);
        println!("{name}: {total:.4} on the solver's layers, {exact:.4} in the limit");
        // Layers of up to 1.4 voxels: the error is of their square, over a mean free path's or the layer's.
        assert!((total / exact - 1.0).abs() < 0.02, "{name}: {total} {exact}");
    }
}

#[test]
fn the_solvers_layers_end_where_the_materials_do() {
    let volume = skin_on_milk();
    let layers = layers_mm(&volume, 0.25);
    let ends: Vec<f64> = layers
        .iter()
        .scan(0.0, |end, dz| {
            *end += dz;
            Some(*end)
        })
        .collect();
    for boundary in [0.5, 2.2, 4.0] {
        assert!(ends.iter().any(|end| (end - boundary).abs() < 1e-9), "{boundary}: {ends:?}");
    }
    // Voxels much thinner than the solver's do not make it finer; the whole is always filled.
    let fine = Volume::layered(&[(optics(1.0, 0.0), 0.01), (optics(2.0, 0.0), 0.01)].repeat(200), 1.3);
    let layers = layers_mm(&fine, 0.25);
    assert!(layers.len() < 40 && (layers.iter().sum::<f64>() - 4.0).abs() < 1e-9, "{}", layers.len());
}

/// Every named medium in slabs of 0.05 to 50 mm at pitches of 0.05 to 2 mm: finite, no brighter than its light, and
/// balanced to a thousandth, which [`SolverSlab::solve`] itself demands.
#[test]
fn every_extreme_converges() {
    let media = table::MEDIA.iter().filter(|m| !m.measured || ["spectralon", "ketchup"].contains(&m.name));
    for medium in media {
        for thickness_mm in [0.05, 0.5, 4.0, 50.0] {
            for pitch_mm in [0.05, 0.5, 2.0] {
                let volume = Volume::uniform(medium.optics, medium.refractive_index, thickness_mm);
                for channel in [0, 2] {
                    let (exitance, spent) = solve(&volume, &domain(0.5 * pitch_mm, 24), channel);
                    let total = exitance.iter().map(|&e| f64::from(e)).sum::<f64>() * (0.5 * pitch_mm).powi(2);
                    let what = format!("{} {channel}, {thickness_mm} mm, pitch {pitch_mm} mm: {total}", medium.name);
                    assert!((spent - 1.0).abs() < 1e-3 && (0.0..1.0).contains(&total), "{what}");
                    assert!(exitance.iter().all(|e| *e >= -1e-6 * exitance[12 * 24 + 12]), "{what}");
                }
            }
        }
    }
}

/// The hardest mixtures: nearly opaque beside or above nearly clear, coefficients that jump ten thousandfold.
#[test]
fn extremes_beside_and_above_each_other_converge() {
    let medium = |name: &str| table::medium(name).unwrap().optics;
    let (opaque, clear, black) = (medium("nearly-opaque"), medium("nearly-clear"), medium("one-channel-black"));
    let board = |a: Optics, b: Optics| Volume {
        voxels: [2, 2],
        voxel_mm: [0.7; 2],
        beyond: Beyond::Repeat,
        optics: vec![a, b, b, a],
        ..Volume::uniform(a, 1.3, 4.0)
    };
    for (name, volume) in [
        ("board", board(opaque, clear)),
        ("board with black", board(clear, black)),
        ("clear on opaque", Volume::layered(&[(clear, 0.5), (opaque, 3.5)], 1.3)),
        ("opaque on clear", Volume::layered(&[(opaque, 0.01), (clear, 3.99)], 1.3)),
        ("void on milk", Volume::layered(&[(optics(0.0, 0.0), 1.0), (optics(2.55, 0.0), 3.0)], 1.3)),
    ] {
        for channel in [0, 2] {
            let (exitance, spent) = solve(&volume, &domain(0.25, 48), channel);
            println!("{name} {channel}: balance {:+.1e}", spent - 1.0);
            assert!(exitance.iter().all(|e| e.is_finite()), "{name}");
        }
    }
}
