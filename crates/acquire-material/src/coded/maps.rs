//! Maps of real numbers: transformed, quantized and coded, each with the transform and the step that cost least.

use super::entropy::{Bits, Reader, Writer};
use super::symbols::{Earlier, Numbers, try_map};
use super::transform::{ALL, Plans, Transform, forward, inverse};
use crate::parallel::*;

/// Steps are powers of 2^(1/STEPS_PER_OCTAVE).
const STEPS_PER_OCTAVE: i32 = 4;
/// 2^(k/4)
const FRACTIONS: [f64; 4] = [1.0, 1.189_207_115_002_721, std::f64::consts::SQRT_2, 1.681_792_830_507_429];
/// No step is outside 2^±this.
const OCTAVES: i32 = 1000;
/// A coefficient of magnitude q is read as q less this part of a step: small ones are likelier than large ones.
const SHRINK: [f64; 3] = [0.0, 0.02, 0.02];
/// Largest quantized magnitude; larger ones would cost more than the numbers themselves.
const LARGEST: f64 = (1 << 24) as f64;

/// The step that number `index` names.
pub(super) fn step(index: i32) -> f64 {
    let octave = index.div_euclid(STEPS_PER_OCTAVE).clamp(-OCTAVES, OCTAVES);
    let power = f64::from_bits(((octave + 1023) as u64) << 52);
    FRACTIONS[index.rem_euclid(STEPS_PER_OCTAVE) as usize] * power
}

/// The number of the step nearest to `step`, on a logarithmic scale.
pub(super) fn step_index(step: f64) -> i32 {
    let octaves = step.log2().clamp(-f64::from(OCTAVES), f64::from(OCTAVES));
    (octaves * f64::from(STEPS_PER_OCTAVE)).round() as i32
}

fn restore(q: i32, step: f64) -> f64 {
    let magnitude = q.unsigned_abs();
    let shrunk = f64::from(magnitude) - SHRINK[(magnitude as usize).min(2)];
    f64::from(q.signum()) * shrunk * step
}

/// A map that was coded: how, and its quantized coefficients.
#[derive(Debug, Clone)]
struct Coded {
    transform: Transform,
    step_index: i32,
    numbers: Vec<i32>,
}

/// Maps of one kind and size, coded one after another; what was learned from one serves the next.
pub(super) struct Group {
    size: [usize; 2],
    /// Maps in a set that belongs together (the planes of one term); those before this one are its siblings.
    siblings: usize,
    numbers: Numbers,
    parameters: Numbers,
    coded: Vec<Coded>,
    plans: Plans,
    first_step: i32,
}

/// What to spend.
#[derive(Debug, Clone, Copy)]
pub(super) struct Price {
    /// Step at a sensitivity of one.
    pub step: f64,
    /// Squared error in units of step² that a bit may save.
    pub lambda: f64,
}

impl Group {
    /// No map yet. `first_step` is the step number that the first one is compared with.
    pub(super) fn new(size: [usize; 2], siblings: usize, first_step: i32) -> Self {
        Self {
            size,
            siblings: siblings.max(1),
            numbers: Numbers::new(),
            parameters: Numbers::new(),
            coded: Vec::new(),
            plans: Plans::default(),
            first_step,
        }
    }

    /// The maps that map `coded.len()` is predicted from, when it has this transform.
    fn earlier(&self, transform: Transform) -> Earlier<'_> {
        let at = self.coded.len();
        let map = |back: usize| {
            let found = self.coded.get(at.checked_sub(back)?)?;
            (found.transform == transform).then_some(found.numbers.as_slice())
        };
        let sibling = if at.is_multiple_of(self.siblings) { None } else { map(1) };
        let second = if at % self.siblings > 1 { map(2) } else { None };
        [map(self.siblings), second.or(map(2 * self.siblings)), sibling]
    }

    fn previous_parameters(&self) -> (Transform, i32) {
        self.coded.last().map_or((ALL[0], self.first_step), |c| (c.transform, c.step_index))
    }

    /// Codes a map whose coefficients move R̂_d by `sensitivity` each, and returns it as a decoder will see it.
    ///
    /// # Errors
    /// Those of the writer.
    pub(super) fn encode(
        &mut self,
        writer: &mut Writer,
        map: &[f64],
        sensitivity: f64,
        price: Price,
    ) -> Result<Vec<f64>, String> {
        let wanted = step_index(price.step / sensitivity.max(1e-200));
        let coefficients = ALL.map(|transform| {
            let mut coefficients = map.to_vec();
            forward(transform, &mut self.plans, &mut coefficients, self.size);
            (transform, coefficients)
        });
        let attempt = |index: i32, (transform, coefficients): &(Transform, Vec<f64>)| {
            // Squared errors in units of price.step²
            let unit = (step(index) * sensitivity / price.step).powi(2);
            let earlier = self.earlier(*transform);
            let (cost, numbers) = try_map(&self.numbers, self.size, earlier, |at, cost| {
                quantize(coefficients[at] / step(index), unit, price.lambda, cost)
            });
            let error = |(q, c): (&i32, &f64)| (restore(*q, 1.0) - c / step(index)).powi(2);
            let distortion = unit * numbers.iter().zip(coefficients).map(error).sum::<f64>();
            let total = distortion + price.lambda * (cost as f64 / 65536.0);
            (total, Coded { transform: *transform, step_index: index, numbers })
        };
        let mut tried: Vec<_> = coefficients.par_iter().map(|c| attempt(wanted, c)).collect();
        if let Some(least) = cheapest(&tried) {
            let kept = coefficients.iter().find(|(t, _)| *t == least.transform);
            let more = kept.map(|c| [wanted - 1, wanted + 1].into_par_iter().map(|index| attempt(index, c)).collect());
            tried.extend::<Vec<_>>(more.unwrap_or_default());
        }
        let coded = cheapest(&tried).cloned().ok_or("no transform could be tried")?;
        self.code(writer, Some(coded))
    }

    /// The next map.
    ///
    /// # Errors
    /// What is wrong with the data.
    pub(super) fn decode(&mut self, reader: &mut Reader) -> Result<Vec<f64>, String> {
        self.code(reader, None)
    }

    fn code<B: Bits>(&mut self, bits: &mut B, coded: Option<Coded>) -> Result<Vec<f64>, String> {
        let (last_transform, last_step) = self.previous_parameters();
        let place = |t: Transform| ALL.iter().position(|a| *a == t).unwrap_or(0) as i32;
        let asked =
            coded.as_ref().map_or([0, 0], |c| [place(c.transform) - place(last_transform), c.step_index - last_step]);
        let found = self.parameters.code_map(bits, [2, 1], [None; 3], |at, _| asked[at])?;
        let transform = usize::try_from(i64::from(place(last_transform)) + i64::from(found[0]));
        let Some(&transform) = transform.ok().and_then(|t| ALL.get(t)) else {
            return Err(format!("coded data: no transform {} after {last_transform:?}", found[0]));
        };
        let index = last_step.checked_add(found[1]).filter(|i| i.abs() <= OCTAVES * STEPS_PER_OCTAVE);
        let Some(step_index) = index else {
            return Err(format!("coded data: a step of 2^({}/4) after 2^({last_step}/4)", found[1]));
        };
        let mut numbers = std::mem::replace(&mut self.numbers, Numbers::new());
        let values = coded.map(|c| c.numbers);
        let choose = |at: usize, _: &dyn Fn(i32) -> u64| values.as_ref().map_or(0, |v| v[at]);
        let map = numbers.code_map(bits, self.size, self.earlier(transform), choose)?;
        self.numbers = numbers;
        let step = step(step_index);
        let mut values: Vec<f64> = map.iter().map(|&q| restore(q, step)).collect();
        inverse(transform, &mut self.plans, &mut values, self.size);
        self.coded.push(Coded { transform, step_index, numbers: map });
        // No later map looks back further.
        if let Some(old) = self.coded.len().checked_sub(2 * self.siblings + 1) {
            self.coded[old].numbers = Vec::new();
        }
        Ok(values)
    }
}

fn cheapest(tried: &[(f64, Coded)]) -> Option<&Coded> {
    tried.iter().min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, coded)| coded)
}

/// The number for coefficient `t` (in steps) that costs least: squared error times `unit` plus `lambda` times its bits.
fn quantize(t: f64, unit: f64, lambda: f64, cost: &dyn Fn(i32) -> u64) -> i32 {
    let sign = if t < 0.0 { -1 } else { 1 };
    let nearest = (t.abs() + 0.5).min(LARGEST) as i32;
    if nearest == 0 {
        return 0;
    }
    let total = |q: i32| {
        let error = restore(q, 1.0) - t.abs();
        unit * error * error + lambda * (cost(q) as f64 / 65536.0)
    };
    let mut best = (total(nearest), nearest);
    for q in [nearest - 1, 0] {
        // Zero is worth asking only where little is lost.
        if q < nearest && (q > 0 || nearest <= 2) {
            let candidate = total(q);
            if candidate < best.0 {
                best = (candidate, q);
            }
        }
    }
    sign * best.1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_fourth_roots_of_powers_of_two() {
        for index in [-41, -4, -3, -1, 0, 1, 2, 3, 4, 27] {
            let expected = 2.0_f64.powf(f64::from(index) / 4.0);
            assert!((step(index) / expected - 1.0).abs() < 1e-15, "rounding: {index} {}", step(index));
            assert_eq!(step_index(expected), index);
            assert_eq!(step_index(expected * 2.0_f64.powf(0.12)), index, "the nearest");
        }
    }

    #[test]
    fn a_coefficient_gets_the_number_that_costs_least() {
        // Bits grow with the number; of zero, one and two more steeply.
        let cost = |q: i32| (65536.0 * [0.5, 3.0, 4.5].get(q as usize).copied().unwrap_or(4.0 + f64::from(q))) as u64;
        let read = |q: i32| f64::from(q) - [0.0, 0.02].get(q as usize).copied().unwrap_or(0.02);
        for (unit, lambda) in [(1.0, 0.08), (0.5, 0.4), (2.0, 0.0)] {
            for k in -90..=90 {
                let t = f64::from(k) * 0.05;
                let nearest = (t.abs() + 0.5).floor() as i32;
                let total = |q: i32| unit * (read(q) - t.abs()).powi(2) + lambda * cost(q) as f64 / 65536.0;
                // The nearest, the one below it, and zero where it is no further than two.
                let tried =
                    [nearest, nearest - 1, 0].into_iter().filter(|&q| q >= 0 && (q >= nearest - 1 || nearest <= 2));
                let least = tried.map(total).fold(f64::INFINITY, f64::min);
                let found = quantize(t, unit, lambda, &cost);
                assert!(f64::from(found) * t >= 0.0, "the sign of {t}: {found}");
                let expected = if nearest == 0 { total(0) } else { least };
                assert!((total(found.abs()) - expected).abs() < 1e-12, "rounding, {t} {unit} {lambda}: {found}");
            }
        }
    }

    fn map(k: usize, size: [usize; 2]) -> Vec<f64> {
        let at = |e: usize| ((e % size[0]) as f64, (e / size[0]) as f64);
        let value = |(x, y): (f64, f64)| 3.0 * (-(x - 2.0).powi(2) / 9.0 - (y - 1.0 - k as f64).powi(2) / 4.0).exp();
        (0..size[0] * size[1]).map(|e| value(at(e)) + 0.2 * ((e * (k + 3)) as f64 * 0.9).sin()).collect()
    }

    #[test]
    fn maps_come_back_within_their_step_in_their_order() {
        let size = [11, 6];
        for (wanted, sensitivity) in [(0.05, 1.0), (0.4, 4.0), (0.001, 0.5)] {
            // Without a price on bits every coefficient gets its nearest number.
            let price = Price { step: wanted, lambda: 0.0 };
            let mut writer = Writer::default();
            let mut group = Group::new(size, 3, step_index(wanted));
            let seen: Vec<Vec<f64>> =
                (0..7).map(|k| group.encode(&mut writer, &map(k, size), sensitivity, price).unwrap()).collect();
            let mut reader = Reader::new(&writer.finish()).unwrap();
            let mut group = Group::new(size, 3, step_index(wanted));
            for (k, seen) in seen.iter().enumerate() {
                assert_eq!(&group.decode(&mut reader).unwrap(), seen, "map {k}");
                let off: f64 = seen.iter().zip(map(k, size)).map(|(a, b)| (a - b).powi(2)).sum();
                // Transforms keep the norm: 66 coefficients, each off by half a step and 0.02 of one; steps are fourth
                // roots of two, the nearest one or the one next to it.
                let most = 0.52 * wanted / sensitivity * 2.0_f64.powf(0.375) * 66.0_f64.sqrt();
                assert!(off.sqrt() <= most, "map {k}: {} {most}", off.sqrt());
            }
        }
    }

    #[test]
    fn a_map_is_predicted_from_the_sets_before_it_and_its_siblings() {
        let mut group = Group::new([2, 1], 3, 0);
        for k in 0..7 {
            let one = Coded { transform: ALL[0], step_index: 0, numbers: vec![10 * k, k] };
            group.coded.push(one);
        }
        // The eighth: second of the third set of three.
        let first = |e: Earlier<'_>| e.map(|m| m.map(|m| m[0]));
        assert_eq!(first(group.earlier(ALL[0])), [Some(40), Some(10), Some(60)]);
        assert_eq!(first(group.earlier(ALL[1])), [None; 3], "of another transform");
        group.coded.push(Coded { transform: ALL[0], step_index: 0, numbers: vec![70, 7] });
        assert_eq!(first(group.earlier(ALL[0])), [Some(50), Some(60), Some(70)], "the third has two siblings");
        group.coded.push(Coded { transform: ALL[0], step_index: 0, numbers: vec![80, 8] });
        assert_eq!(first(group.earlier(ALL[0])), [Some(60), Some(30), None], "the first has none");
    }
}
