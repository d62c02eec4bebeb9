//! Where diffusion does not describe a slab.

use super::diffusion::CHANNEL_NAMES;
use crate::SimulateWarning;
use crate::simulate::slab::{Optics, SlabRecord, Volume};

/// Findings per medium and channel: a mean free path longer than the slab is thick or the window wide, or more
/// absorption than scattering. Of a voxel file's voxels, the worst of each channel stands for all.
pub(crate) fn warnings(volume: &Volume, record: &SlabRecord, window_mm: f64) -> Vec<SimulateWarning> {
    let lengths = [("slab's thickness", volume.thickness_mm()), ("window", window_mm)];
    let shortest = if lengths[0].1 <= lengths[1].1 { lengths[0] } else { lengths[1] };
    let mut found = Vec::new();
    for channel in 0..3 {
        for medium in &record.media {
            found.extend(too_clear(&medium.name, &medium.optics, channel, shortest));
            found.extend(too_dark(&medium.name, &medium.optics, channel));
        }
        if record.media.is_empty() {
            found.extend(of_voxels(volume, channel, shortest));
        }
    }
    found
}

fn too_clear(
    name: &str,
    optics: &Optics,
    channel: usize,
    (exceeds, length_mm): (&str, f64),
) -> Option<SimulateWarning> {
    let extinction = optics.extinction_per_mm(channel);
    (extinction * length_mm < 1.0).then(|| SimulateWarning::DiffusionTooClear {
        medium: name.into(),
        channel: CHANNEL_NAMES[channel],
        mean_free_path_mm: (extinction > 0.0).then(|| 1.0 / extinction),
        exceeds: exceeds.into(),
        length_mm,
    })
}

fn too_dark(name: &str, optics: &Optics, channel: usize) -> Option<SimulateWarning> {
    let (scattering, absorption) = (optics.reduced_scattering_per_mm[channel], optics.absorption_per_mm[channel]);
    (absorption > scattering).then(|| SimulateWarning::DiffusionTooDark {
        medium: name.into(),
        channel: CHANNEL_NAMES[channel],
        reduced_scattering_per_mm: scattering,
        absorption_per_mm: absorption,
    })
}

/// Fewer voxels than this share of a file are not worth a warning: light that meets them meets others within a mean
/// free path.
const NOTED_SHARE: f64 = 0.1;

/// The clearest and the darkest of the voxels that fall short, with their number.
fn of_voxels(volume: &Volume, channel: usize, shortest: (&str, f64)) -> Vec<SimulateWarning> {
    let all = volume.optics.len();
    let worst = |falls_short: &dyn Fn(&Optics) -> Option<f64>| {
        let badness = volume.optics.iter().filter_map(|o| falls_short(o).map(|badness| (o, badness)));
        let (count, worst) = badness.fold((0, None), |(count, worst): (usize, Option<(&Optics, f64)>), next| {
            (count + 1, Some(worst.filter(|w| w.1 >= next.1).unwrap_or(next)))
        });
        let worst = worst.filter(|_| count as f64 >= NOTED_SHARE * all as f64);
        worst.map(|(optics, _)| (format!("{count} of {all} voxels, the worst"), optics))
    };
    let clear = worst(&|o| Some(-o.extinction_per_mm(channel)).filter(|e| -e * shortest.1 < 1.0));
    let dark = worst(&|o| {
        Some(o.absorption_per_mm[channel] - o.reduced_scattering_per_mm[channel]).filter(|excess| *excess > 0.0)
    });
    let clear = clear.and_then(|(name, optics)| too_clear(&name, optics, channel, shortest));
    let dark = dark.and_then(|(name, optics)| too_dark(&name, optics, channel));
    clear.into_iter().chain(dark).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::SimulateOptions;
    use crate::simulate::slab::layout::{SlabPlace, build};

    fn found(material: &str) -> Vec<SimulateWarning> {
        let place = SlabPlace { lit_origin_mm: [0.0; 2], lit_size_mm: [8.0; 2], size_mm: [16.0; 2] };
        let built =
            build(&SimulateOptions { material: material.parse().unwrap(), ..SimulateOptions::default() }, &place)
                .unwrap();
        warnings(&built.volume, &built.record, 7.5)
    }

    #[test]
    fn diffusive_media_pass_and_others_are_named_with_their_channel() {
        for sound in ["homogeneous", "marble", "chessboard-4x4", "layered", "cream", "lossless", "nearly-opaque"] {
            assert_eq!(found(sound), [], "{sound}");
        }
        // Ketchup absorbs more than it scatters in green and blue; both extinctions are above 1/4 mm⁻¹, red's is not.
        let kinds: Vec<String> = found("ketchup").iter().map(ToString::to_string).collect();
        assert_eq!(kinds.len(), 3, "{kinds:?}");
        assert!(kinds[0].contains("ketchup, R") && kinds[0].contains("4.149 mm"), "{kinds:?}");
        assert!(kinds[1].contains("ketchup, G") && kinds[1].contains("0.97"), "{kinds:?}");
        assert_eq!(found("nearly-clear").len(), 3);
        let black = found("one-channel-black");
        assert!(matches!(&black[..], [SimulateWarning::DiffusionTooDark { channel: 'B', .. }]), "{black:?}");
    }

    #[test]
    fn the_worst_voxel_stands_for_a_file() {
        let medium = |s: f64, a: f64| Optics {
            reduced_scattering_per_mm: [s; 3],
            absorption_per_mm: [a; 3],
            anisotropy: [0.0; 3],
        };
        let optics = vec![medium(1.0, 0.0), medium(0.1, 0.0), medium(0.0, 0.0), medium(1.0, 2.0)];
        let volume = Volume { voxels: [4, 1], optics, ..Volume::uniform(medium(1.0, 0.0), 1.3, 4.0) };
        let place = SlabPlace { lit_origin_mm: [0.0; 2], lit_size_mm: [8.0; 2], size_mm: [16.0; 2] };
        let mut record = build(&SimulateOptions::default(), &place).unwrap().record;
        record.media.clear();
        let found = warnings(&volume, &record, 7.5);
        assert_eq!(found.len(), 6);
        assert!(found[0].to_string().contains("2 of 4 voxels") && found[0].to_string().contains("infinite"));
        assert!(found[1].to_string().contains("1 of 4 voxels"), "{}", found[1]);
    }
}
