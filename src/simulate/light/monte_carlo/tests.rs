//! The photon walk against published numbers, and the laws that it must keep.

use super::*;
use crate::simulate::{Beyond, Optics, Volume};
use std::f64::consts::PI;

/// A layer in the units of the papers: µa, µs in cm⁻¹, thickness in cm.
fn layer(absorption_per_cm: f64, scattering_per_cm: f64, g: f64, thickness_cm: f64) -> (Optics, f64) {
    let optics = Optics {
        reduced_scattering_per_mm: [0.1 * scattering_per_cm * (1.0 - g); 3],
        absorption_per_mm: [0.1 * absorption_per_cm; 3],
        anisotropy: [g; 3],
    };
    (optics, 10.0 * thickness_cm)
}

fn isotropic(scattering_per_mm: f64, absorption_per_mm: f64) -> Optics {
    Optics {
        reduced_scattering_per_mm: [scattering_per_mm; 3],
        absorption_per_mm: [absorption_per_mm; 3],
        anisotropy: [0.0; 3],
    }
}

fn totals(volume: &Volume, channel: usize, photons: u64) -> Outcome {
    trace(&Setup::totals(&Medium::new(volume, channel)), &TraceOptions { photons, seed: 1 }, None).unwrap()
}

/// Within 3 standard errors of `expected`, which has an error of its own (its last digit, or its own noise), and known
/// to 0.1 %.
fn agrees(what: &str, found: Estimate, expected: f64, own_error: f64) {
    let error = found.standard_error;
    println!("{what}: {:.5} ± {error:.5}, expected {expected}", found.mean);
    assert!(error <= 1e-3 * expected, "{what}: standard error {error} of {expected}");
    let off = (found.mean - expected).abs();
    assert!(off <= 3.0 * error.hypot(own_error), "{what}: {} ± {error}, expected {expected}", found.mean);
}

/// Van de Hulst 1980 by way of Wang et al. 1995, table 1, and the exponential law for what is not scattered.
#[test]
fn a_slab_without_faces_agrees_with_van_de_hulst() {
    let volume = Volume::layered(&[layer(10.0, 90.0, 0.75, 0.02)], 1.0);
    let outcome = totals(&volume, 0, 12_000_000);
    agrees("reflectance", outcome.reflected, 0.09739, 3e-6);
    agrees("transmittance", outcome.transmitted, 0.66096, 3e-6);
    agrees("ballistic", outcome.ballistic, (-2.0f64).exp(), 0.0);
    agrees("diffuse transmittance", outcome.diffuse, 0.66096 - (-2.0f64).exp(), 3e-6);
}

/// Giovanelli 1955 by way of Wang et al. 1995, table 2; 50 mm are 500 free paths.
#[test]
fn a_half_space_behind_a_face_agrees_with_giovanelli() {
    let volume = Volume::layered(&[layer(10.0, 90.0, 0.0, 5.0)], 1.5);
    let outcome = totals(&volume, 0, 4_000_000);
    let total = Estimate { mean: outcome.reflected.mean + outcome.specular, ..outcome.reflected };
    agrees("reflectance with specular", total, 0.2600, 3e-5);
}

/// Adding and doubling (Prahl's iad): the totals of 5 mm of marble, specular included.
#[test]
#[ignore = "slow: 8 million photons a channel"]
fn marble_agrees_with_adding_and_doubling() {
    let marble = Optics {
        reduced_scattering_per_mm: [2.19, 2.62, 3.00],
        absorption_per_mm: [0.0021, 0.0041, 0.0071],
        anisotropy: [0.0; 3],
    };
    let volume = Volume::uniform(marble, 1.5, 5.0);
    for (channel, (r, t)) in [(0.7618, 0.1905), (0.7631, 0.1495), (0.7493, 0.1134)].into_iter().enumerate() {
        let outcome = totals(&volume, channel, 8_000_000);
        let total = Estimate { mean: outcome.reflected.mean + outcome.specular, ..outcome.reflected };
        agrees("reflectance", total, r, 3e-5);
        agrees("transmittance", outcome.transmitted, t, 3e-5);
    }
}

/// The sample of MCML's manual (Wang & Jacques 1992): a million photons, rings of 0.01 cm, the last of which holds the
/// overflow.
#[test]
#[ignore = "slow: 6 million photons"]
fn three_layers_agree_with_the_sample_of_mcml() {
    let layers = [layer(1.0, 100.0, 0.9, 0.1), layer(1.0, 10.0, 0.0, 0.1), layer(2.0, 10.0, 0.7, 0.2)];
    let volume = Volume::layered(&layers, 1.37);
    let rings = Some(Rings { width_mm: 0.1, count: 20 });
    let options = TraceOptions { photons: 6_000_000, seed: 1 };
    let outcome = trace(&Setup { rings, ..Setup::totals(&Medium::new(&volume, 0)) }, &options, None).unwrap();
    assert!((outcome.specular - 0.024_372_9).abs() < 1e-7);
    // Theirs scatters by √6 times ours in each: a million photons against six.
    let joint = |ours: Estimate| 6f64.sqrt() * ours.standard_error;
    agrees("R_d", outcome.reflected, 0.237544, joint(outcome.reflected));
    agrees("absorbed", outcome.absorbed, 0.641594, joint(outcome.absorbed));
    agrees("transmitted", outcome.transmitted, 0.0964896, joint(outcome.transmitted));
    for (ring, per_cm2) in [(0, 30.924), (1, 10.071), (2, 6.1187), (4, 3.5138), (9, 1.5409), (19, 0.42576)] {
        let (ours, theirs) = (outcome.rings[ring], 0.01 * per_cm2);
        println!(
            "R_d at {:.3} cm: {:.5} ± {:.5} mm⁻², MCML {theirs}",
            0.01 * ring as f64 + 0.005,
            ours.mean,
            ours.standard_error
        );
        let error = ours.standard_error.hypot(joint(ours));
        assert!((ours.mean - theirs).abs() <= 3.0 * error, "ring {ring}: {ours:?}, MCML {theirs}");
    }
}

/// Chandrasekhar's H for isotropic scattering: H = 1/(√(1 − ϖ) + ϖ/2 ∫ t H(t)/(µ + t) dt), by iteration on `n`
/// midpoints.
fn chandrasekhar_h(albedo: f64, mu: f64) -> f64 {
    let n = 2000;
    let node = |i: usize| (i as f64 + 0.5) / n as f64;
    let next = |h: &[f64], mu: f64| {
        let sum: f64 = h.iter().enumerate().map(|(i, h)| node(i) * h / (mu + node(i))).sum();
        1.0 / ((1.0 - albedo).sqrt() + 0.5 * albedo * sum / n as f64)
    };
    let mut h = vec![1.0; n];
    for _ in 0..60 {
        h = (0..n).map(|i| 0.5 * h[i] + 0.5 * next(&h, node(i))).collect();
    }
    next(&h, mu)
}

/// All that a far eye at cosine `mu` to the normal receives from a pencil beam.
fn shown(volume: &Volume, mu: f64, azimuth: f64, photons: u64) -> Estimate {
    let wide = 1e4;
    let window = Some(TallyWindow { corner_mm: [-0.5 * wide; 2], cell_mm: wide, cells: [1; 2] });
    let aside = (1.0 - mu * mu).sqrt() * 1e9;
    let eye_mm = Some([aside * azimuth.cos(), aside * azimuth.sin(), -mu * 1e9]);
    let medium = Medium::new(volume, 0);
    let setup = Setup { window, eye_mm, ..Setup::totals(&medium) };
    // Another seed for each eye, so that their errors are independent.
    let seed = (1e6 * (mu + azimuth)) as u64;
    let map = trace(&setup, &TraceOptions { photons, seed }, None).unwrap().radiance.unwrap();
    Estimate { mean: map.mean[0] * wide * wide, standard_error: map.standard_error[0] * wide * wide }
}

/// π I/F = ϖ/4 · µ0/(µ + µ0) · H(µ) H(µ0) (Chandrasekhar 1960, §37), light at the normal. (Of 32 seeds at µ = 1
/// the mean z was −0.05, the largest 3.3.)
#[test]
#[ignore = "slow: 12 million photons"]
fn the_eye_sees_a_half_space_as_chandrasekhar_did() {
    let volume = Volume::uniform(isotropic(0.9, 0.1), 1.0, 100.0);
    for mu in [1.0, 0.5, 0.2] {
        let expected = 0.9 / 4.0 / (1.0 + mu) * chandrasekhar_h(0.9, mu) * chandrasekhar_h(0.9, 1.0);
        agrees("radiance", shown(&volume, mu, 2.0, 4_000_000), expected, 1e-5);
    }
}

/// What all eyes see together is what leaves: ∫ 2µ · πL dµ = R, through faces, with forward scattering, through voxels.
#[test]
#[ignore = "slow: 4 million photons that show themselves"]
fn radiance_over_the_hemisphere_is_the_exitance() {
    let skin = Optics { anisotropy: [0.6; 3], ..isotropic(1.1, 0.05) };
    let milk = Optics { anisotropy: [-0.3; 3], ..isotropic(2.5, 0.002) };
    let mut volume = Volume::layered(&[(skin, 0.4), (milk, 0.8)], 1.4);
    volume.voxels = [2, 1];
    volume.voxel_mm = [0.3, 1.0];
    volume.beyond = Beyond::Repeat;
    volume.optics = vec![skin, milk, milk, milk];
    // Gauss and Legendre on 0..1, eight nodes, good to 1e-3 here. The eye misses what flies out unscattered: 4e-4 of
    // it.
    let half = [
        (0.183_434_642_495_65, 0.362_683_783_378_362),
        (0.525_532_409_916_329, 0.313_706_645_877_887),
        (0.796_666_477_413_627, 0.222_381_034_453_374),
        (0.960_289_856_497_536, 0.101_228_536_290_376),
    ];
    let nodes = half.iter().flat_map(|&(x, w)| [(0.5 - 0.5 * x, 0.5 * w), (0.5 + 0.5 * x, 0.5 * w)]);
    let (mut sum, mut variance) = (0.0, 0.0);
    for (mu, weight) in nodes {
        // Six azimuths: the voxels look alike from opposite sides, and what differs more often than twice a turn is
        // small.
        for azimuth in 0..6 {
            let seen = shown(&volume, mu, (f64::from(azimuth) + 0.5) * PI / 3.0, 40_000);
            let weight = 2.0 * mu * weight / 6.0;
            sum += weight * seen.mean;
            variance += (weight * seen.standard_error).powi(2);
        }
    }
    let leaves = totals(&volume, 0, 2_000_000).reflected;
    println!(
        "hemisphere {sum:.5} ± {:.5}, exitance {:.5} ± {:.5}",
        variance.sqrt(),
        leaves.mean,
        leaves.standard_error
    );
    assert!((sum - leaves.mean).abs() < 3.0 * variance.sqrt().hypot(leaves.standard_error) + 1e-3 * leaves.mean);
}

/// Ketchup and cream of Jensen et al. 2001, red, in a chessboard that is neither centred nor square to the points.
fn heterogeneous() -> Volume {
    let (ketchup, cream) = (isotropic(0.18, 0.061), isotropic(7.38, 0.0002));
    let mut volume = Volume::layered(&[(ketchup, 0.7), (cream, 1.3)], 1.3);
    volume.origin_mm = [0.13, -0.21];
    volume.voxel_mm = [0.9, 1.1];
    volume.voxels = [2, 2];
    volume.beyond = Beyond::Repeat;
    volume.optics = vec![ketchup, cream, cream, ketchup, cream, cream, ketchup, ketchup];
    volume
}

/// Light in at a, seen from the normal at b, and the other way round (Helmholtz).
#[test]
#[ignore = "slow: 8 million photons in all"]
fn a_heterogeneous_slab_is_reciprocal() {
    let volume = heterogeneous();
    let side = 0.5;
    let seen = |from: Point, at: Point| {
        let mm_from_px = [[side, 0.0], [0.0, side]];
        let beam = Beam { center_mm: from, mm_from_px, side_px: 1.0, round: false, blur_px: 0.0 };
        let window = Some(TallyWindow { corner_mm: at.map(|c| c - 0.5 * side), cell_mm: side, cells: [1; 2] });
        let eye_mm = Some([0.0, 0.0, -1e9]);
        let medium = Medium::new(&volume, 0);
        let setup = Setup { beam, window, eye_mm, ..Setup::totals(&medium) };
        let map = trace(&setup, &TraceOptions { photons: 2_000_000, seed: 5 + (100.0 * from[0]) as u64 }, None)
            .unwrap()
            .radiance
            .unwrap();
        Estimate { mean: map.mean[0], standard_error: map.standard_error[0] }
    };
    for (a, b) in [([0.5, 0.2], [1.4, 0.3]), ([0.5, 0.2], [1.3, 1.2])] {
        let (there, back) = (seen(a, b), seen(b, a));
        let error = there.standard_error.hypot(back.standard_error);
        println!("there {:.5} back {:.5} ± {error:.5}", there.mean, back.mean);
        assert!(error < 0.02 * there.mean && (there.mean - back.mean).abs() < 3.0 * error, "{there:?} {back:?}");
    }
}

#[test]
fn energy_balances_in_a_heterogeneous_slab_with_sides() {
    let volume = heterogeneous();
    let extent_mm = Some([[-1.0, -1.5], [2.0, 1.0]]);
    let outcome = trace(
        &Setup { extent_mm, ..Setup::totals(&Medium::new(&volume, 0)) },
        &TraceOptions { photons: 400_000, seed: 2 },
        None,
    );
    let outcome = outcome.unwrap();
    let Estimate { mean, standard_error } = outcome.spent;
    println!("spent {mean} ± {standard_error}, {outcome:?}");
    assert!(standard_error < 1e-3 && (mean - 1.0).abs() < 3.0 * standard_error);
    assert!([outcome.reflected, outcome.transmitted, outcome.absorbed, outcome.sides].iter().all(|e| e.mean > 0.01));
}

#[test]
fn the_same_seed_gives_the_same_numbers_on_any_number_of_threads() {
    let volume = heterogeneous();
    let window = Some(TallyWindow { corner_mm: [-2.0; 2], cell_mm: 0.25, cells: [16; 2] });
    let medium = Medium::new(&volume, 0);
    let setup = Setup { window, exitance: true, eye_mm: Some([3.0, 0.0, -90.0]), ..Setup::totals(&medium) };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| trace(&setup, &TraceOptions { photons: 10_000, seed: 9 }, None).unwrap())
    };
    assert_eq!(with(1), with(3));
}

/// The standard error is that of the mean: over 40 seeds the estimates scatter as they say, to 5 standard errors of a
/// standard deviation from 40 values (1/√78 each).
#[test]
fn standard_errors_are_right() {
    let volume = heterogeneous();
    let outcomes: Vec<Outcome> = (0..40)
        .map(|seed| {
            trace(&Setup::totals(&Medium::new(&volume, 0)), &TraceOptions { photons: 5_000, seed }, None).unwrap()
        })
        .collect();
    let mean = outcomes.iter().map(|o| o.reflected.mean).sum::<f64>() / 40.0;
    let scatter = (outcomes.iter().map(|o| (o.reflected.mean - mean).powi(2)).sum::<f64>() / 39.0).sqrt();
    let told = (outcomes.iter().map(|o| o.reflected.standard_error.powi(2)).sum::<f64>() / 40.0).sqrt();
    assert!((scatter / told - 1.0).abs() < 5.0 / 78f64.sqrt(), "{scatter} {told}");
}

#[test]
fn extreme_media_end_and_balance() {
    let cases = [
        ("empty", Volume::uniform(isotropic(0.0, 0.0), 1.5, 1.0)),
        ("black", Volume::uniform(isotropic(0.0, 100.0), 1.5, 1.0)),
        ("nearly opaque", Volume::uniform(isotropic(1000.0, 1.0), 1.3, 1.0)),
        ("nearly clear", Volume::uniform(isotropic(1e-3, 0.0), 1.5, 1.0)),
        ("lossless", Volume::uniform(isotropic(3.0, 0.0), 1.5, 1.0)),
        ("thin", Volume::uniform(isotropic(1.0, 0.1), 1.3, 1e-3)),
        ("forward", Volume::uniform(Optics { anisotropy: [0.99; 3], ..isotropic(1.0, 0.1) }, 1.3, 1.0)),
        ("backward", Volume::uniform(Optics { anisotropy: [-0.99; 3], ..isotropic(1.0, 0.1) }, 1.3, 1.0)),
        ("clear over black", Volume::layered(&[(isotropic(0.0, 0.0), 1.0), (isotropic(0.0, 50.0), 1.0)], 1.3)),
    ];
    for (name, volume) in cases {
        let window = Some(TallyWindow { corner_mm: [-2.0; 2], cell_mm: 0.5, cells: [8; 2] });
        let medium = Medium::new(&volume, 0);
        let setup = Setup { window, exitance: true, eye_mm: Some([0.0, 0.0, -50.0]), ..Setup::totals(&medium) };
        let outcome = trace(&setup, &TraceOptions { photons: 20_000, seed: 4 }, None).unwrap();
        let Estimate { mean, standard_error } = outcome.spent;
        // Where nothing is random the sum is 1 to rounding.
        assert!((mean - 1.0).abs() < 4.0 * standard_error + 1e-9, "{name}: {:?}", outcome.spent);
        let maps = [outcome.exitance.unwrap(), outcome.radiance.unwrap()];
        assert!(maps.iter().all(|m| m.mean.iter().all(|v| v.is_finite() && *v >= 0.0)), "{name}");
    }
    // Without matter what Fresnel lets through both faces remains: (1 − F)/(1 + F), F = 0.04.
    let empty = totals(&Volume::uniform(isotropic(0.0, 0.0), 1.5, 1.0), 0, 2_000_000);
    agrees("empty slab", empty.ballistic, 0.96 / 1.04, 0.0);
    let rings = PI * Rings { width_mm: 0.5, count: 2 }.area_mm2(1) / PI;
    assert!((rings - PI * (1.0 - 0.25)).abs() < 1e-12);
}

/// Adding and doubling (benches/peers/photons/adding_doubling.py, good to 4e-7): all measured media 4 mm thick, marble
/// also 5 mm, some with g = 0.8.
///
/// Of a hundred comparisons some are off by more than 3 standard errors, hence 4; all together must scatter as they
/// say: χ² over its degrees of freedom is 1 to five of its standard deviations, which a bias of half a standard error
/// would break.
#[test]
#[ignore = "slow: 24 million photons"]
fn all_measured_media_agree_with_adding_and_doubling() {
    let table = include_str!("../../../../tests/data/adding_doubling.csv");
    let (mut chi2, mut count) = (0.0, 0.0);
    for (seed, line) in table.lines().filter(|line| line.contains("mm,")).enumerate() {
        let fields: Vec<&str> = line.split(',').collect();
        let value = |i: usize| fields[i].parse::<f64>().unwrap();
        let [absorption, scattering, g, n, thickness] = [2, 3, 4, 5, 6].map(value);
        let optics = Optics { anisotropy: [g; 3], ..isotropic(scattering * (1.0 - g), absorption) };
        let medium = Medium::new(&Volume::uniform(optics, n, thickness), 0);
        let options = TraceOptions { photons: 500_000, seed: seed as u64 };
        let outcome = trace(&Setup::totals(&medium), &options, None).unwrap();
        assert!((outcome.specular - value(7)).abs() < 1e-6);
        let pairs =
            [(outcome.reflected, value(8) - value(7)), (outcome.transmitted, value(9)), (outcome.absorbed, value(10))];
        for (ours, expected) in pairs {
            let z = (ours.mean - expected) / ours.standard_error.max(1e-6);
            println!(
                "{} {}: {:.5} ± {:.5}, expected {expected:.5}, z {z:.1}",
                fields[0], fields[1], ours.mean, ours.standard_error
            );
            assert!(z.abs() < 4.0, "{line}: {ours:?}, expected {expected}");
        }
        // The three add up, so that two are independent.
        for (ours, expected) in &pairs[..2] {
            chi2 += ((ours.mean - expected) / ours.standard_error.max(1e-6)).powi(2);
            count += 1.0;
        }
    }
    println!("χ² {chi2:.1} over {count}");
    assert!(count == 96.0 && (chi2 / count - 1.0).abs() < 5.0 * (2.0f64 / count).sqrt());
}
