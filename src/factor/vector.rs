//! Sums and combinations of vectors, with the vector instructions of the processor at hand.
//!
//! No fused multiply-add: results are the same on every processor.

use pulp::{Arch, NullaryFnOnce};

/// Parts of a sum, one for each of so many neighbours: a single one would wait for each addition.
const LANES: usize = 16;
pub(super) type Lanes = [f64; LANES];

/// Adds products of whole parts; gives what is left of both.
#[inline(always)]
fn add_parts<'a>(sum: &mut Lanes, a: &'a [f64], b: &'a [f64]) -> (&'a [f64], &'a [f64]) {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut lanes = *sum;
    for (a, b) in a.iter().zip(b) {
        for k in 0..LANES {
            lanes[k] += a[k] * b[k];
        }
    }
    *sum = lanes;
    (a_rest, b_rest)
}

/// Adds a b to the parts of a sum, inside a dispatched function.
#[inline(always)]
pub(super) fn add_products_in(sum: &mut Lanes, a: &[f64], b: &[f64]) {
    let (a, b) = add_parts(sum, a, b);
    sum.iter_mut().zip(a).zip(b).for_each(|((lane, a), b)| *lane += a * b);
}

/// Adds values to the parts of a sum, inside a dispatched function.
#[inline(always)]
pub(super) fn add_all_in(sum: &mut Lanes, values: &[f64]) {
    let (parts, rest) = values.as_chunks::<LANES>();
    let mut lanes = *sum;
    for part in parts {
        for k in 0..LANES {
            lanes[k] += part[k];
        }
    }
    lanes.iter_mut().zip(rest).for_each(|(lane, v)| *lane += v);
    *sum = lanes;
}

struct Dot<'a>(&'a [f64], &'a [f64]);

impl NullaryFnOnce for Dot<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        dot_in(self.0, self.1)
    }
}

/// Σ a b.
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    Arch::new().dispatch(Dot(a, b))
}

/// Σ a b inside a dispatched function.
#[inline(always)]
pub(super) fn dot_in(a: &[f64], b: &[f64]) -> f64 {
    let mut lanes = [0.0; LANES];
    let (a_rest, b_rest) = add_parts(&mut lanes, a, b);
    let mut sum = 0.0;
    for k in 0..LANES {
        sum += lanes[k];
    }
    for (a, b) in a_rest.iter().zip(b_rest) {
        sum += a * b;
    }
    sum
}

/// Σ v.
pub(super) fn sum(values: &[f64]) -> f64 {
    Arch::new().dispatch(Sum(values))
}

struct Sum<'a>(&'a [f64]);

impl NullaryFnOnce for Sum<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let mut lanes = [0.0; LANES];
        add_all_in(&mut lanes, self.0);
        lanes.iter().sum()
    }
}

/// y ← y + x.
pub(super) fn add(y: &mut [f64], x: &[f64]) {
    Arch::new().dispatch(Add(y, x));
}

struct Add<'a>(&'a mut [f64], &'a [f64]);

impl NullaryFnOnce for Add<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.0.iter_mut().zip(self.1).for_each(|(y, x)| *y += x);
    }
}

/// y ← y + x of f32.
pub(super) fn add_wide(y: &mut [f64], x: &[f32]) {
    Arch::new().dispatch(AddWide(y, x));
}

struct AddWide<'a>(&'a mut [f64], &'a [f32]);

impl NullaryFnOnce for AddWide<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.0.iter_mut().zip(self.1).for_each(|(y, &x)| *y += f64::from(x));
    }
}

/// Σ a b of f32, each product in f64.
pub(super) fn dot_wide(a: &[f32], b: &[f32]) -> f64 {
    Arch::new().dispatch(DotWide(a, b))
}

struct DotWide<'a>(&'a [f32], &'a [f32]);

impl NullaryFnOnce for DotWide<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let ((a, a_rest), (b, b_rest)) = (self.0.as_chunks::<LANES>(), self.1.as_chunks::<LANES>());
        let mut lanes = [0.0_f64; LANES];
        for (a, b) in a.iter().zip(b) {
            for k in 0..LANES {
                lanes[k] += f64::from(a[k]) * f64::from(b[k]);
            }
        }
        for (k, (a, b)) in a_rest.iter().zip(b_rest).enumerate() {
            lanes[k] += f64::from(*a) * f64::from(*b);
        }
        lanes.iter().sum()
    }
}

/// Σ (a m − s b n)² of f32, in f64.
pub(super) fn misfit(a: &[f32], m: &[f32], s: f64, b: &[f32], n: &[f32]) -> f64 {
    Arch::new().dispatch(Misfit { a, m, s, b, n })
}

struct Misfit<'a> {
    a: &'a [f32],
    m: &'a [f32],
    s: f64,
    b: &'a [f32],
    n: &'a [f32],
}

impl NullaryFnOnce for Misfit<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let Self { a, m, s, b, n } = self;
        let len = a.len().min(m.len()).min(b.len()).min(n.len());
        let (a, m, b, n) = (&a[..len], &m[..len], &b[..len], &n[..len]);
        let mut lanes = [0.0_f64; LANES];
        let whole = len / LANES * LANES;
        for at in (0..whole).step_by(LANES) {
            let [a, m, b, n] = [a, m, b, n].map(|v| &v[at..at + LANES]);
            for k in 0..LANES {
                let apart = f64::from(a[k]) * f64::from(m[k]) - s * f64::from(b[k]) * f64::from(n[k]);
                lanes[k] += apart * apart;
            }
        }
        for k in whole..len {
            let apart = f64::from(a[k]) * f64::from(m[k]) - s * f64::from(b[k]) * f64::from(n[k]);
            lanes[k - whole] += apart * apart;
        }
        lanes.iter().sum()
    }
}

struct EnergyAndPeak<'a>(&'a [f32]);

impl NullaryFnOnce for EnergyAndPeak<'_> {
    type Output = (f64, f64);

    #[inline(always)]
    fn call(self) -> (f64, f64) {
        let (parts, rest) = self.0.as_chunks::<LANES>();
        let (mut sums, mut peaks) = ([0.0_f64; LANES], [0.0_f32; LANES]);
        for part in parts {
            for k in 0..LANES {
                sums[k] += f64::from(part[k]) * f64::from(part[k]);
                peaks[k] = if part[k] > peaks[k] { part[k] } else { peaks[k] };
            }
        }
        let (mut sum, mut peak) = (0.0, 0.0_f32);
        for k in 0..LANES {
            (sum, peak) = (sum + sums[k], peak.max(peaks[k]));
        }
        for &v in rest {
            (sum, peak) = (sum + f64::from(v) * f64::from(v), peak.max(v));
        }
        (sum, f64::from(peak))
    }
}

/// Σ v², and the largest value; 0 when none is positive.
pub(super) fn energy_and_peak(values: &[f32]) -> (f64, f64) {
    Arch::new().dispatch(EnergyAndPeak(values))
}

struct Range<'a>(&'a [f64]);

impl NullaryFnOnce for Range<'_> {
    type Output = [f64; 2];

    #[inline(always)]
    fn call(self) -> [f64; 2] {
        let (parts, rest) = self.0.as_chunks::<LANES>();
        let (mut low, mut high) = ([f64::INFINITY; LANES], [f64::NEG_INFINITY; LANES]);
        for part in parts {
            for k in 0..LANES {
                low[k] = if part[k] < low[k] { part[k] } else { low[k] };
                high[k] = if part[k] > high[k] { part[k] } else { high[k] };
            }
        }
        let all = low.iter().zip(&high).map(|(&l, &h)| [l, h]).chain(rest.iter().map(|&v| [v, v]));
        all.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], [l, h]| [low.min(l), high.max(h)])
    }
}

/// The smallest and the largest value; \[∞, −∞\] of an empty slice.
pub(super) fn range(values: &[f64]) -> [f64; 2] {
    Arch::new().dispatch(Range(values))
}

/// y ← y + s x inside a dispatched function.
#[inline(always)]
pub(super) fn axpy_in(s: f64, x: &[f64], y: &mut [f64]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y += s * x;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whole numbers: every order of summation gives the same sum.
    fn numbers(n: usize) -> (Vec<f64>, Vec<f64>) {
        (0..n).map(|k| ((k * 7 % 11) as f64 - 4.0, (k * 5 % 13) as f64 - 3.0)).unzip()
    }

    #[test]
    fn a_product_has_every_entry_once_whatever_the_length() {
        for n in [0, 1, 15, 16, 17, 32, 47, 100] {
            let (a, b) = numbers(n);
            let mut naive = 0.0;
            for k in 0..n {
                naive += a[k] * b[k];
            }
            assert_eq!(dot(&a, &b), naive, "{n} entries");
        }
    }

    #[test]
    fn sums_of_narrow_products_have_every_entry_once_and_are_made_in_f64() {
        let narrow = |v: &[f64]| v.iter().map(|&v| v as f32).collect::<Vec<f32>>();
        for n in [0, 1, 15, 16, 17, 47] {
            let (a, b) = numbers(n);
            let m: Vec<f64> = (0..n).map(|k| (k % 3) as f64 + 0.5).collect();
            assert_eq!(dot_wide(&narrow(&a), &narrow(&b)), dot(&a, &b), "{n} entries");
            let expected: f64 = (0..n).map(|k| (a[k] * m[k] - 2.0 * b[k] * (m[k] - 1.0)).powi(2)).sum();
            let less: Vec<f64> = m.iter().map(|m| m - 1.0).collect();
            assert_eq!(misfit(&narrow(&a), &narrow(&m), 2.0, &narrow(&b), &narrow(&less)), expected, "{n} entries");
        }
        // Products beyond f32.
        assert_eq!(dot_wide(&[2e30], &[3e30]), f64::from(2e30_f32) * f64::from(3e30_f32));
    }

    #[test]
    fn sums_have_every_entry_once_whatever_the_length() {
        for n in [0, 1, 15, 16, 17, 47] {
            let (mut a, b) = numbers(n);
            assert_eq!(sum(&a), a.iter().sum::<f64>(), "{n} entries");
            let both: Vec<f64> = a.iter().zip(&b).map(|(a, b)| a + b).collect();
            add(&mut a, &b);
            assert_eq!(a, both);
            add_wide(&mut a, &b.iter().map(|&b| b as f32).collect::<Vec<f32>>());
            assert!((0..n).all(|k| a[k] == both[k] + b[k]));
        }
    }

    #[test]
    fn the_energy_is_a_sum_of_squares_and_the_peak_the_largest_wherever_it_stands() {
        for n in [1, 15, 16, 40] {
            for at in [0, n / 2, n - 1] {
                let mut values: Vec<f32> = (0..n).map(|k| -((k % 5) as f32) - 1.0).collect();
                let rest: f64 = values.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
                let replaced = f64::from(values[at]).powi(2);
                assert_eq!(energy_and_peak(&values), (rest, 0.0), "none is positive");
                values[at] = 3.0;
                assert_eq!(energy_and_peak(&values), (rest - replaced + 9.0, 3.0), "{n} values, {at}");
            }
        }
        assert_eq!(energy_and_peak(&[]), (0.0, 0.0));
        // Squares of 1e30 are beyond f32.
        let (energy, peak) = energy_and_peak(&[1e30, -2e30, 1e-30]);
        assert!((energy / 5e60 - 1.0).abs() < 1e-6 && peak == f64::from(1e30_f32), "f32 inputs: {energy:e} {peak:e}");
    }

    #[test]
    fn ranges_have_the_smallest_and_the_largest_wherever_they_stand() {
        for n in [1, 15, 16, 40] {
            for at in [0, n / 2, n - 1] {
                let mut values: Vec<f64> = (0..n).map(|k| (k % 5) as f64 + 1.0).collect();
                values[at] = -3.0;
                assert_eq!(range(&values)[0], -3.0, "{n} {at}");
                values[at] = 7.0;
                assert_eq!(range(&values)[1], 7.0, "{n} {at}");
            }
        }
        assert_eq!(range(&[]), [f64::INFINITY, f64::NEG_INFINITY]);
    }

    #[test]
    fn a_multiple_is_added_entry_by_entry() {
        let (x, mut y) = numbers(21);
        let expected: Vec<f64> = (0..21).map(|k| y[k] - 2.5 * x[k]).collect();
        axpy_in(-2.5, &x, &mut y);
        assert_eq!(y, expected);
    }
}
