//! What is coded without loss, or to a stated error: raw numbers, shifts, positions.

use super::entropy::Bits;
use super::symbols::Numbers;
use crate::Point;

/// Codes `count` bits as they are.
///
/// # Errors
/// Those of `bits`.
pub(super) fn raw<B: Bits>(bits: &mut B, value: u64, count: u32) -> Result<u64, String> {
    let mut found = 0;
    for k in (0..count).rev() {
        found = found << 1 | u64::from(bits.code(value >> k & 1 == 1, 1 << 15)?);
    }
    Ok(found)
}

/// Codes a finite f32 as its 32 bits.
///
/// # Errors
/// Those of `bits`; a number that is not finite.
pub(super) fn raw_f32<B: Bits>(bits: &mut B, value: f32) -> Result<f32, String> {
    let found = f32::from_bits(raw(bits, u64::from(value.to_bits()), 32)? as u32);
    if found.is_finite() { Ok(found) } else { Err(format!("expected a finite number, found {found}")) }
}

/// Codes a finite f64 as its 64 bits.
///
/// # Errors
/// Those of `bits`; a number that is not finite.
pub(super) fn raw_f64<B: Bits>(bits: &mut B, value: f64) -> Result<f64, String> {
    let found = f64::from_bits(raw(bits, value.to_bits(), 64)?);
    if found.is_finite() { Ok(found) } else { Err(format!("expected a finite number, found {found}")) }
}

/// Codes g_j: one bit when all are the singular values of the header, else 32 bits each.
///
/// # Errors
/// Those of `bits`.
pub(super) fn weights<B: Bits>(
    bits: &mut B,
    weights: &[f32],
    singular_values: &[f64],
    terms: usize,
) -> Result<Vec<f32>, String> {
    let known = singular_values.iter().take(terms).map(|&v| v as f32);
    let same = bits.code(weights.iter().copied().eq(known.clone()), 1 << 15)?;
    if same {
        return if singular_values.len() >= terms {
            Ok(known.collect())
        } else {
            Err("weights: not in the header".into())
        };
    }
    let mut found = Vec::new();
    for j in 0..terms {
        found.push(raw_f32(bits, weights.get(j).copied().unwrap_or(0.0)).map_err(|e| format!("weights: {e}"))?);
    }
    Ok(found)
}

/// Codes the rows' shifts without loss.
///
/// # Errors
/// Those of `bits`; a shift that is no i16.
pub(super) fn shifts<B: Bits>(bits: &mut B, shifts: &[[i16; 2]], points: [usize; 2]) -> Result<Vec<[i16; 2]>, String> {
    if !bits.code(shifts.iter().any(|s| *s != [0, 0]), 1 << 15)? {
        return Ok(vec![[0, 0]; points[0] * points[1]]);
    }
    let mut numbers = Numbers::new();
    let asked = |a: usize| move |at: usize, _: &dyn Fn(i32) -> u64| shifts.get(at).map_or(0, |s| i32::from(s[a]));
    let x = numbers.code_map(bits, points, [None; 3], asked(0))?;
    let y = numbers.code_map(bits, points, [None, None, Some(&x)], asked(1))?;
    let both = x.iter().zip(&y).map(|(&x, &y)| Some([i16::try_from(x).ok()?, i16::try_from(y).ok()?]));
    both.collect::<Option<Vec<_>>>().ok_or_else(|| "shift: expected whole numbers of 16 bits".into())
}

/// Positions in whole steps from the grid that fits them best.
const LARGEST: f64 = (1 << 24) as f64;
/// How a position's distance from the grid is predicted.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Prediction {
    /// There is none.
    Zero,
    /// The mean of the left and the upper neighbour.
    Mean,
    /// The plane through three neighbours.
    Plane,
    /// As so many points to the left, or up, else as `Mean`: the points that one shot lights have drifted together.
    Period(u64),
}

/// Longest period that is looked for.
const LONGEST_PERIOD: u64 = 64;

impl Prediction {
    fn code<B: Bits>(self, bits: &mut B) -> Result<Self, String> {
        let (kind, period) = match self {
            Self::Zero => (0, 1),
            Self::Mean => (1, 1),
            Self::Plane => (2, 1),
            Self::Period(p) => (3, p),
        };
        Ok(match raw(bits, kind, 2)? {
            0 => Self::Zero,
            1 => Self::Mean,
            2 => Self::Plane,
            _ => Self::Period(raw(bits, period - 1, 6)? + 1),
        })
    }

    /// Which of them leaves the smallest numbers.
    fn best(steps: &[i32], width: usize) -> Self {
        // Twice the logarithm.
        let left = |how: &Self| -> u64 {
            (0..steps.len())
                .map(|k| (i64::from(steps[k]) - i64::from(how.guess(steps, width, k))).unsigned_abs() + 1)
                .map(|r| u64::from((r * r).ilog2()))
                .sum()
        };
        let all = [Self::Zero, Self::Mean, Self::Plane].into_iter().chain((1..=LONGEST_PERIOD).map(Self::Period));
        all.min_by_key(left).unwrap_or(Self::Zero)
    }

    fn guess(self, steps: &[i32], width: usize, at: usize) -> i32 {
        let value = |back: usize| i64::from(steps[at - back]);
        let (x, y) = (at % width, at / width);
        let guess = match self {
            Self::Zero => 0,
            Self::Period(p) if x >= p as usize => value(p as usize),
            Self::Period(p) if y >= p as usize => value(p as usize * width),
            _ if at == 0 => 0,
            _ if y == 0 => value(1),
            _ if x == 0 => value(width),
            Self::Mean | Self::Period(_) => (value(1) + value(width)).div_euclid(2),
            Self::Plane => value(1) + value(width) - value(width + 1),
        };
        guess.clamp(-(1 << 26), 1 << 26) as i32
    }
}

/// Codes the positions; each is kept to half of `quantum_mm` along x and along y (or to 2⁻²⁵ of how far they stray from
/// the grid, where that is more), plus the rounding of positions to f32.
///
/// # Errors
/// Those of `bits`; numbers that no encoder writes.
pub(super) fn positions<B: Bits>(
    bits: &mut B,
    lit_mm: &[Point],
    points: [usize; 2],
    quantum_mm: f64,
) -> Result<Vec<Point>, String> {
    let mut found: Vec<Point> = Vec::new();
    let mut numbers = Numbers::new();
    let mut first: Option<Vec<i32>> = None;
    for axis in 0..2 {
        let values: Vec<f64> = lit_mm.iter().map(|p| p[axis]).collect();
        let mut grid = fit(&values, points);
        for v in &mut grid {
            *v = raw_f64(bits, *v).map_err(|e| format!("lit_mm: {e}"))?;
        }
        let off: Vec<f64> = values.iter().enumerate().map(|(k, v)| v - on_grid(&grid, points, k)).collect();
        let most = off.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        let quantum = raw_f64(bits, quantum_mm.max(most / LARGEST)).map_err(|e| format!("lit_mm: {e}"))?;
        let steps: Vec<i32> = off.iter().map(|v| (v / quantum).round() as i32).collect();
        let earlier = [None, None, first.as_deref()];
        let how = Prediction::best(&steps, points[0]).code(bits)?;
        let asked: Vec<i32> = (0..steps.len()).map(|k| steps[k] - how.guess(&steps, points[0], k)).collect();
        let coded = numbers.code_map(bits, points, earlier, |at, _| asked.get(at).copied().unwrap_or(0))?;
        let mut steps: Vec<i32> = Vec::with_capacity(coded.len());
        for (k, r) in coded.iter().enumerate() {
            steps.push(r.wrapping_add(how.guess(&steps, points[0], k)));
        }
        if axis == 0 {
            found.resize(coded.len(), [0.0; 2]);
        }
        for (k, (point, &s)) in found.iter_mut().zip(&steps).enumerate() {
            // As the plain file would keep it.
            point[axis] = f64::from((on_grid(&grid, points, k) + f64::from(s) * quantum) as f32);
        }
        first = Some(coded);
    }
    Ok(found)
}

/// Value at the middle of a grid and its slopes along both indices, by least squares; zeros without values.
fn fit(values: &[f64], points: [usize; 2]) -> [f64; 3] {
    if values.is_empty() {
        return [0.0; 3];
    }
    let middle = points.map(|p| (p - 1) as f64 / 2.0);
    let index = |k: usize| [(k % points[0]) as f64 - middle[0], (k / points[0]) as f64 - middle[1]];
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let slope = |a: usize| {
        let (mut product, mut square) = (0.0, 0.0);
        for (k, v) in values.iter().enumerate() {
            product += index(k)[a] * (v - mean);
            square += index(k)[a].powi(2);
        }
        if square > 0.0 { product / square } else { 0.0 }
    };
    [mean, slope(0), slope(1)]
}

fn on_grid(grid: &[f64; 3], points: [usize; 2], at: usize) -> f64 {
    let middle = points.map(|p| (p - 1) as f64 / 2.0);
    grid[0] + grid[1] * ((at % points[0]) as f64 - middle[0]) + grid[2] * ((at / points[0]) as f64 - middle[1])
}

#[cfg(test)]
mod tests {
    use super::super::entropy::{Reader, Writer};
    use super::*;

    #[test]
    fn shifts_along_x_and_y_come_back_each_as_its_own() {
        let points = [5, 3];
        let moved: Vec<[i16; 2]> = (0..15).map(|k| [(k * 7 % 11) - 5, (k * k % 9) * 31 - 3]).collect();
        for asked in [moved, vec![[0, 0]; 15]] {
            let mut w = Writer::default();
            assert_eq!(shifts(&mut w, &asked, points).unwrap(), asked);
            assert_eq!(shifts(&mut Reader::new(&w.finish()).unwrap(), &[], points).unwrap(), asked);
        }
    }

    #[test]
    fn weights_come_from_the_header_or_by_themselves() {
        let singular = [3.0, 1.5, 0.25, 0.125];
        for asked in [vec![3.0_f32, 1.5, 0.25], vec![3.0, 0.25, 1.5], vec![-1e-30, 7e20, 0.0]] {
            let mut w = Writer::default();
            assert_eq!(weights(&mut w, &asked, &singular, 3).unwrap(), asked);
            let bytes = w.finish();
            assert_eq!(weights(&mut Reader::new(&bytes).unwrap(), &[], &singular, 3).unwrap(), asked);
        }
    }

    #[test]
    fn positions_are_off_by_half_a_step_at_the_most_on_any_lattice() {
        let points = [6, 4];
        let quantum = 0.01;
        let turned = |k: usize| {
            let (i, j) = ((k % 6) as f64, (k / 6) as f64);
            // Turned and sheared, with a period of three along x and some unrest along y.
            [2.5 + 0.75 * i - 0.1 * j + 0.03 * (i % 3.0), -8.0 + 0.2 * i + 1.5 * j + 0.04 * (k as f64 * 1.7).sin()]
        };
        let far = |k: usize| [((k * k) % 17) as f64 * 3.0, -2.0 * ((k * 5) % 7) as f64];
        let places: [&dyn Fn(usize) -> [f64; 2]; 2] = [&turned, &far];
        for place in places {
            let asked: Vec<Point> = (0..24).map(place).collect();
            let mut w = Writer::default();
            let seen = positions(&mut w, &asked, points, quantum).unwrap();
            let read = positions(&mut Reader::new(&w.finish()).unwrap(), &[], points, 0.0).unwrap();
            assert_eq!(seen, read);
            for (found, asked) in read.iter().zip(&asked) {
                for a in 0..2 {
                    // Half a step, and the rounding of f32 at 48 mm.
                    assert!((found[a] - asked[a]).abs() <= quantum / 2.0 + 2e-6, "{found:?} {asked:?}");
                }
            }
        }
    }

    #[test]
    fn predictions_use_the_neighbours_that_they_name() {
        // 4 × 3, line by line.
        let steps = [5, 1, 8, 2, 7, 3, 9, 4, 6, 20, 11, 13];
        let guess = |how: Prediction, at: usize| how.guess(&steps, 4, at);
        assert_eq!(guess(Prediction::Zero, 6), 0);
        assert_eq!(guess(Prediction::Mean, 6), (3 + 8) / 2, "left and above, rounded down");
        assert_eq!(guess(Prediction::Plane, 6), 3 + 8 - 1);
        assert_eq!((guess(Prediction::Mean, 2), guess(Prediction::Plane, 4)), (1, 5), "one neighbour on the rim");
        assert_eq!(guess(Prediction::Period(2), 6), 7, "two before");
        assert_eq!(guess(Prediction::Period(2), 9), 1, "two above where x is too small");
        assert_eq!(guess(Prediction::Period(3), 5), (7 + 1) / 2, "the mean where neither is there");
        assert_eq!(guess(Prediction::Plane, 0), 0);
    }

    #[test]
    fn raw_numbers_come_back_bit_by_bit_and_must_be_finite() {
        let mut w = Writer::default();
        raw(&mut w, 0b1_0110, 5).unwrap();
        raw_f32(&mut w, -1.25e-30).unwrap();
        raw_f64(&mut w, std::f64::consts::PI).unwrap();
        assert!(raw_f32(&mut w, f32::NAN).is_err() && raw_f64(&mut w, f64::INFINITY).is_err());
        let mut r = Reader::new(&w.finish()).unwrap();
        assert_eq!(raw(&mut r, 0, 5), Ok(0b1_0110));
        assert_eq!(raw_f32(&mut r, 0.0), Ok(-1.25e-30));
        assert_eq!(raw_f64(&mut r, 0.0), Ok(std::f64::consts::PI));
        assert!(raw_f32(&mut r, 0.0).is_err());
    }
}
