//! Makes a mistake in a capture: its steps one after another, then its edits.

use crate::capture::{Capture, Place};
use crate::data::{Mistake, Operation, Step};
use crate::picture::{Container, Picture, replace};
use crate::sensor::{deviate, encode};
use crate::{edit, optics};
use rand::SeedableRng;
use rand_pcg::Pcg64;

/// What was changed, in the order of shooting.
#[derive(Debug, Default)]
pub(crate) struct Touched {
    /// Names of files, without their folder.
    pub photographs: Vec<String>,
    pub shots: Vec<String>,
}

pub(crate) fn tamper(capture: &mut Capture, mistake: &Mistake) -> Touched {
    let seed = mistake.id.bytes().fold(7u64, |sum, byte| sum.wrapping_mul(31).wrapping_add(u64::from(byte)));
    let mut generator = Pcg64::seed_from_u64(seed);
    let mut places: Vec<Place> = Vec::new();
    for step in &mistake.steps {
        places.extend(make(capture, step, &mut generator));
    }
    mistake.edits.iter().for_each(|edit| edit::apply(capture, edit));
    capture.save();
    places.sort_unstable();
    places.dedup();
    let file = |&(shot, exposure): &Place| {
        let file = &capture.shots[shot].photographs[exposure].file;
        file.rsplit('/').next().unwrap().to_owned()
    };
    let mut shots: Vec<String> = places.iter().map(|&(shot, _)| capture.shots[shot].name.clone()).collect();
    shots.dedup();
    Touched { photographs: places.iter().map(file).collect(), shots }
}

/// Makes one step and says which photographs it changed.
fn make(capture: &mut Capture, step: &Step, generator: &mut Pcg64) -> Vec<Place> {
    let mut chosen = capture.chosen(&step.on);
    match &step.operation {
        &Operation::Delay { share, ahead, shots, channel } => {
            chosen.retain(|&(shot, _)| capture.beside(shot, ahead, shots).is_some());
            // Each finds the one beside it as it was.
            let order: Vec<Place> = if ahead { chosen.clone() } else { chosen.iter().rev().copied().collect() };
            for place in order {
                let source = capture.beside(place.0, ahead, shots).unwrap();
                delay(capture, (place, source), (share, channel), &chosen, generator);
            }
        }
        Operation::Exchange { with } => {
            let others = capture.chosen_shots(&step.on.of, *with);
            let mut further = Vec::new();
            for &(shot, exposure) in &chosen {
                let other = (*others.iter().find(|&&k| k != shot).expect("another shot"), exposure);
                let (a, b) = (std::fs::read(capture.path((shot, exposure))), std::fs::read(capture.path(other)));
                replace(&capture.path((shot, exposure)), &b.unwrap());
                replace(&capture.path(other), &a.unwrap());
                further.push(other);
            }
            chosen.extend(further);
        }
        Operation::ExchangeTimes => {
            let mut kept: Vec<Place> = Vec::new();
            for same in chosen.chunk_by(|a, b| a.0 == b.0) {
                let (first, last) = (same[0], same[same.len() - 1]);
                let (mut a, mut b) = (capture.read(first), capture.read(last));
                std::mem::swap(&mut a.exif, &mut b.exif);
                a.write(&capture.path(first));
                b.write(&capture.path(last));
                kept.extend([first, last]);
            }
            chosen = kept;
        }
        Operation::ManifestTime { factor } => {
            for &place in &chosen {
                let secs = factor * capture.secs(place);
                capture.entry(place).insert("exposure_secs".into(), secs.into());
            }
        }
        Operation::Dots { add, mirror } => {
            let shots = capture.chosen_shots(&step.on.of, step.on.which);
            edit::dots(capture, &shots, *add, *mirror);
        }
        Operation::ShorterAgain => {
            for &(shot, exposure) in &chosen {
                let (from, mut to) = (capture.read((shot, exposure - 1)), capture.read((shot, exposure)));
                to.codes = again(capture, &from, generator);
                to.write(&capture.path((shot, exposure)));
            }
        }
        operation => {
            if let Operation::Show { of, which, share } = operation {
                let source = capture.chosen_shots(std::slice::from_ref(of), *which)[0];
                chosen.iter().for_each(|&place| show(capture, place, source, *share, generator));
            } else if !of_files(capture, operation, &chosen) {
                optics::change(capture, operation, &chosen, generator);
            }
        }
    }
    chosen
}

/// The light of the shot beside this one. Where that stays as it is there are two of one pattern, each with noise of
/// its own.
fn delay(
    capture: &Capture,
    (place, shot): (Place, usize),
    (share, channel): (f64, Option<usize>),
    chosen: &[Place],
    generator: &mut Pcg64,
) {
    let source = (shot, place.1.min(capture.shots[shot].photographs.len() - 1));
    if share < 1.0 {
        let (here, there) = (capture.light(place), capture.light(source));
        let parts = here.iter().zip(&there).enumerate().map(|(k, (h, t))| match channel {
            Some(c) if c != k % 3 => (vec![(1.0, *h)], 0.0),
            _ => (vec![(1.0 - share, *h), (share, *t)], 0.0),
        });
        return optics::write_light(capture, place, parts, generator);
    }
    let (from, mut to) = (capture.read(source), capture.read(place));
    to.codes = if chosen.contains(&source) { from.codes } else { again(capture, &from, generator) };
    to.write(&capture.path(place));
}

/// The same scene photographed once more: some noise of its own, so that no two pictures are equal.
fn again(capture: &Capture, picture: &Picture, generator: &mut Pcg64) -> Vec<u16> {
    let sensor = &capture.sensor;
    let fresh = |&code: &u16| {
        let light = sensor.light(code);
        let noise = deviate(generator, 0.25 * sensor.variance(light));
        if sensor.saturated(light) { code } else { sensor.code(light + noise) }
    };
    picture.codes.iter().map(fresh).collect()
}

fn show(capture: &Capture, place: Place, source: usize, share: Option<f64>, generator: &mut Pcg64) {
    let secs = capture.secs(place);
    let far = |e: &usize| (capture.secs((source, *e)) / secs).ln().abs();
    let exposures = 0..capture.shots[source].photographs.len();
    let exposure = exposures.min_by(|a, b| far(a).total_cmp(&far(b))).unwrap();
    let ratio = secs / capture.secs((source, exposure));
    let (here, there) = (capture.light(place), capture.light((source, exposure)));
    let parts = here.iter().zip(&there).map(|(h, t)| match share {
        Some(share) => (vec![(1.0, *h), (share * ratio, *t)], 0.0),
        None => (vec![(ratio, *t)], if ratio == 1.0 { 0.25 } else { 0.0 }),
    });
    optics::write_light(capture, place, parts, generator);
}

/// What concerns files and code values; false for an operation of light.
fn of_files(capture: &Capture, operation: &Operation, chosen: &[Place]) -> bool {
    let each = |how: &dyn Fn(&mut Picture)| {
        for &place in chosen {
            let mut picture = capture.read(place);
            how(&mut picture);
            picture.write(&capture.path(place));
        }
    };
    let sensor = &capture.sensor;
    match operation {
        Operation::Turn => each(&|p| {
            p.codes = p.codes.as_chunks::<3>().0.iter().rev().flatten().copied().collect();
        }),
        Operation::Mirror => each(&|p| {
            let rows = p.codes.chunks(3 * p.size[0]);
            p.codes = rows.flat_map(|row| row.as_chunks::<3>().0.iter().rev().flatten().copied()).collect();
        }),
        Operation::Bgr => each(&|p| p.codes.as_chunks_mut::<3>().0.iter_mut().for_each(|rgb| rgb.swap(0, 2))),
        Operation::Clip { share } => {
            let limit = sensor.code(share * sensor.range());
            each(&|p| p.codes.iter_mut().for_each(|c| *c = (*c).min(limit)));
        }
        Operation::Offset { share } => {
            let dn = share * sensor.range();
            each(&|p| p.codes.iter_mut().for_each(|c| *c = sensor.code(sensor.light(*c) + dn)));
        }
        Operation::Bits { left } => {
            let shift = |c: u16| if *left >= 0 { c << left } else { c >> -left };
            each(&|p| p.codes.iter_mut().for_each(|c| *c = shift(*c)));
        }
        Operation::EightBits => each(&|p| {
            p.container = Container::Png8;
            p.codes.iter_mut().for_each(|c| *c >>= sensor.bits - 8);
        }),
        Operation::Srgb => {
            let range = sensor.largest() - sensor.black;
            let one = |c: u16| (65535.0 * encode((sensor.light(c) / range).clamp(0.0, 1.0))).round() as u16;
            each(&|p| {
                p.says_srgb = true;
                p.codes.iter_mut().for_each(|c| *c = one(*c));
            });
        }
        Operation::ExifTime { factor } => each(&|p| {
            let secs = p.exposure_secs().unwrap();
            p.set_exposure_secs(factor * secs);
        }),
        Operation::WithoutExif => each(&|p| p.exif = None),
        Operation::Half => each(&|p| {
            let [width, height] = p.size.map(|s| s / 2);
            let pixel = |k: usize| 3 * (2 * (k / width) * p.size[0] + 2 * (k % width));
            p.codes = (0..width * height).flat_map(|k| p.codes[pixel(k)..pixel(k) + 3].to_vec()).collect();
            p.size = [width, height];
        }),
        Operation::Cut { share } => {
            for &place in chosen {
                let bytes = std::fs::read(capture.path(place)).unwrap();
                replace(&capture.path(place), &bytes[..(share * bytes.len() as f64) as usize]);
            }
        }
        _ => return false,
    }
    true
}
