//! What happens to light: the lamp, the room, the lens. Every value becomes a sum of photographed ones, and gets the
//! noise it lacks.

use crate::capture::{Capture, Place};
use crate::data::Operation;
use crate::sensor::deviate;
use rand::RngExt;
use rand_pcg::Pcg64;

/// Photographed light with its weights, and light that is added.
pub(crate) type Parts = (Vec<(f64, f64)>, f64);

/// Writes the sum of each pixel's parts. Noise: of the sum as it would have been photographed, less what the parts have
/// brought.
pub(crate) fn write_light(capture: &Capture, place: Place, parts: impl Iterator<Item = Parts>, generator: &mut Pcg64) {
    let sensor = &capture.sensor;
    let code = |(parts, added): Parts| {
        let light = added + parts.iter().map(|(weight, light)| weight * light).sum::<f64>();
        let brought: f64 = parts.iter().map(|(weight, light)| weight * weight * sensor.variance(*light)).sum();
        sensor.code(light + deviate(generator, sensor.variance(light) - brought))
    };
    let mut picture = capture.read(place);
    picture.codes = parts.map(code).collect();
    picture.write(&capture.path(place));
}

pub(crate) fn change(capture: &Capture, operation: &Operation, chosen: &[Place], generator: &mut Pcg64) {
    let longest = chosen.iter().map(|&place| capture.secs(place)).fold(0.0, f64::max);
    let shots = chosen.chunk_by(|a, b| a.0 == b.0);
    let count = shots.clone().count();
    let seen = capture.sensitivity();
    for (number, shot) in shots.enumerate() {
        let along = if count > 1 { number as f64 / (count - 1) as f64 } else { 1.0 };
        // The longest first: where it is saturated, what the shorter ones show is still as it was photographed.
        for &place in shot.iter().rev() {
            let light = capture.light(place);
            let [width, height] = capture.read(place).size;
            let pixel = |k: usize| (k / 3 % width, k / 3 / width);
            let scaled = |factor: &dyn Fn(usize) -> f64| -> Vec<Parts> {
                light.iter().enumerate().map(|(k, l)| (vec![(factor(k), *l)], 0.0)).collect()
            };
            let added = |dn: &dyn Fn(usize) -> f64| -> Vec<Parts> {
                light.iter().enumerate().map(|(k, l)| (vec![(1.0, *l)], dn(k))).collect()
            };
            let disc = |at: &[f64; 2], radius: f64, k: usize| {
                let (x, y) = pixel(k);
                let far = (x as f64 / width as f64 - at[0]).hypot((y as f64 - at[1] * height as f64) / width as f64);
                1.0 / (1.0 + (far / radius).powi(6))
            };
            let full = capture.sensor.range() * capture.secs(place) / longest;
            let picture = Plane { size: [width, height], light: &light };
            let parts = match operation {
                Operation::Lamp { from, to } => {
                    let factor = from.map_or(*to, |from| from + (to - from) * along);
                    scaled(&|_| factor)
                }
                Operation::Ambient { share } => added(&|k| {
                    let (x, y) = pixel(k);
                    share * full * seen(x, y)
                }),
                Operation::Dark => scaled(&|_| 0.0),
                Operation::Shadow { at, radius, depth } => scaled(&|k| 1.0 - depth * disc(at, *radius, k)),
                Operation::Glint { at, radius, share } => added(&|k| share * full * disc(at, *radius, k)),
                Operation::Bands { depth, period_px } => {
                    let phase: f64 = generator.random();
                    scaled(&|k| 1.0 + depth * (std::f64::consts::TAU * (pixel(k).1 as f64 / period_px + phase)).sin())
                }
                Operation::Balance { factors } => scaled(&|k| factors[k % 3]),
                Operation::Shift { px } => picture.sampled(&|[x, y]| [x - px[0], y - px[1]]),
                Operation::Zoom { factor } => {
                    let middle = [width, height].map(|s| (s as f64 - 1.0) / 2.0);
                    picture.sampled(&|at| std::array::from_fn(|i| middle[i] + (at[i] - middle[i]) / factor))
                }
                Operation::Blur { sd_px } => picture.blurred(*sd_px),
                Operation::Sharpen { amount, sd_px } => {
                    // The camera does this to its code values: their noise goes the same way.
                    let blurred = picture.blurred(*sd_px).into_iter().map(|(parts, _)| sum(&parts));
                    let mut photograph = capture.read(place);
                    let each = photograph.codes.iter_mut().zip(light.iter().zip(blurred));
                    each.for_each(|(c, (l, b))| *c = capture.sensor.code(l + amount * (l - b)));
                    photograph.write(&capture.path(place));
                    continue;
                }
                other => panic!("{other:?} is no operation of light"),
            };
            write_light(capture, place, parts.into_iter(), generator);
        }
    }
}

fn sum(parts: &[(f64, f64)]) -> f64 {
    parts.iter().map(|(weight, light)| weight * light).sum()
}

struct Plane<'a> {
    size: [usize; 2],
    light: &'a [f64],
}

impl Plane<'_> {
    fn at(&self, x: i64, y: i64, channel: usize) -> f64 {
        let clamped = |v: i64, axis: usize| v.clamp(0, self.size[axis] as i64 - 1) as usize;
        self.light[3 * (clamped(y, 1) * self.size[0] + clamped(x, 0)) + channel]
    }

    /// Each pixel from the place that `from` names, by cubic interpolation (Catmull and Rom).
    fn sampled(&self, from: &dyn Fn([f64; 2]) -> [f64; 2]) -> Vec<Parts> {
        let cubic = |t: f64| {
            let (t2, t3) = (t * t, t * t * t);
            [-t + 2.0 * t2 - t3, 2.0 - 5.0 * t2 + 3.0 * t3, t + 4.0 * t2 - 3.0 * t3, t3 - t2].map(|w| w / 2.0)
        };
        self.each(&|x, y, channel| {
            let at = from([x as f64, y as f64]);
            let [i, j] = at.map(|v| v.floor() as i64 - 1);
            let (across, down) = (cubic(at[0] - at[0].floor()), cubic(at[1] - at[1].floor()));
            let weights = (0..16).map(|k| (across[k % 4] * down[k / 4], (i + (k % 4) as i64, j + (k / 4) as i64)));
            weights.filter(|(w, _)| *w != 0.0).map(|(w, (x, y))| (w, self.at(x, y, channel))).collect()
        })
    }

    fn blurred(&self, sd_px: f64) -> Vec<Parts> {
        let reach = (3.0 * sd_px).ceil() as i64;
        let weight = |k: i64| (-0.5 * (k as f64 / sd_px).powi(2)).exp();
        let total: f64 = (-reach..=reach).map(weight).sum();
        self.each(&|x, y, channel| {
            let row = |j: i64| (-reach..=reach).map(move |i| (i, j));
            let near = (-reach..=reach).flat_map(row);
            let one = |(i, j): (i64, i64)| {
                (weight(i) * weight(j) / (total * total), self.at(x as i64 + i, y as i64 + j, channel))
            };
            near.map(one).collect()
        })
    }

    fn each(&self, parts: &dyn Fn(usize, usize, usize) -> Vec<(f64, f64)>) -> Vec<Parts> {
        let [width, _] = self.size;
        (0..self.light.len()).map(|k| (parts(k / 3 % width, k / 3 / width, k % 3), 0.0)).collect()
    }
}
