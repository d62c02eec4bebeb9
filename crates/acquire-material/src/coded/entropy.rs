//! Adaptive binary coding of bits, whole numbers and text, over the range coder of the crate `constriction`.
//!
//! Every probability is made of integers only (context mixing after `Mahoney2005`): each context keeps the probability
//! of its next bit, the log-odds of several contexts are added with weights that are learned while coding, and the sum
//! is the probability that the range coder gets. Encoder and decoder learn the same things in the same order on every
//! machine.

use constriction::backends::Cursor;
use constriction::stream::model::{DecoderModel, EncoderModel, EntropyModel};
use constriction::stream::queue::{RangeDecoder, RangeEncoder};
use constriction::stream::{Decode, Encode};
use std::borrow::Borrow;
use std::num::NonZeroU32;
use std::sync::LazyLock;

/// Bits of a probability.
const PRECISION: usize = 16;
const ONE: i32 = 1 << PRECISION;
/// Log-odds are counted in 1/256 and end at ±8.
const LARGEST_STRETCH: i32 = 2047;
/// 65536 / (1 + exp(−k/2)), k = −16 … 16, rounded.
const LOGISTIC: [i32; 33] = [
    22, 36, 60, 98, 162, 267, 439, 720, 1179, 1921, 3108, 4971, 7812, 11955, 17625, 24743, 32768, 40793, 47911, 53581,
    57724, 60565, 62428, 63615, 64357, 64816, 65097, 65269, 65374, 65438, 65476, 65500, 65514,
];

/// The probability of 1, in 1/65536, that log-odds in 1/256 mean.
fn squash(stretch: i32) -> i32 {
    let at = stretch.clamp(-LARGEST_STRETCH, LARGEST_STRETCH) + 2048;
    let (k, part) = ((at >> 7) as usize, at & 127);
    (LOGISTIC[k] * (128 - part) + LOGISTIC[k + 1] * part + 64) >> 7
}

/// The inverse of [`squash`] by the upper 12 bits of a probability.
static STRETCH: LazyLock<Vec<i16>> = LazyLock::new(|| {
    let mut at = -LARGEST_STRETCH;
    let inverse = |k: i32| {
        while at < LARGEST_STRETCH && squash(at) < k * 16 + 8 {
            at += 1;
        }
        at as i16
    };
    (0..4096).map(inverse).collect()
});

fn stretch(probability: u16) -> i32 {
    i32::from(STRETCH[usize::from(probability >> 4)])
}

/// Where bits go to or come from.
pub(super) trait Bits {
    /// Codes a bit whose probability of being 1 is `one`/65536; a decoder ignores `bit` and returns its own.
    ///
    /// # Errors
    /// A reason, when a decoder has no more data.
    fn code(&mut self, bit: bool, one: u16) -> Result<bool, String>;
}

/// Two symbols: 0 with what is left, 1 with `one`.
#[derive(Clone, Copy)]
struct Bernoulli {
    one: u16,
}

impl Bernoulli {
    fn zero(self) -> u32 {
        ONE as u32 - u32::from(self.one.max(1))
    }

    fn part(self, bit: bool) -> (u32, NonZeroU32) {
        let (left, size) = if bit { (self.zero(), u32::from(self.one.max(1))) } else { (0, self.zero()) };
        (left, NonZeroU32::new(size).unwrap_or(NonZeroU32::MIN))
    }
}

impl EntropyModel<PRECISION> for Bernoulli {
    type Symbol = bool;
    type Probability = u32;
}

impl EncoderModel<PRECISION> for Bernoulli {
    fn left_cumulative_and_probability(&self, symbol: impl Borrow<bool>) -> Option<(u32, NonZeroU32)> {
        Some(self.part(*symbol.borrow()))
    }
}

impl DecoderModel<PRECISION> for Bernoulli {
    fn quantile_function(&self, quantile: u32) -> (bool, u32, NonZeroU32) {
        let bit = quantile >= self.zero();
        let (left, size) = self.part(bit);
        (bit, left, size)
    }
}

/// Writes bits.
#[derive(Default)]
pub(super) struct Writer(RangeEncoder<u32, u64>);

impl Writer {
    /// The coded bytes: little-endian words of the range coder.
    ///
    /// # Errors
    /// A reason, when there is no memory left.
    pub(super) fn finish(self) -> Vec<u8> {
        let Ok(words) = self.0.into_compressed();
        words.iter().flat_map(|w| w.to_le_bytes()).collect()
    }
}

impl Bits for Writer {
    fn code(&mut self, bit: bool, one: u16) -> Result<bool, String> {
        self.0.encode_symbol(bit, Bernoulli { one }).map_err(|e| e.to_string())?;
        Ok(bit)
    }
}

/// Reads what [`Writer`] wrote.
pub(super) struct Reader {
    coder: RangeDecoder<u32, u64, Cursor<u32, Vec<u32>>>,
    /// Bits read since the coder may have run out of words.
    beyond: u64,
}

impl Reader {
    /// `bytes` as [`Writer::finish`] gave them.
    ///
    /// # Errors
    /// A reason, when they are not whole words.
    pub(super) fn new(bytes: &[u8]) -> Result<Self, String> {
        let (words, rest) = bytes.as_chunks::<4>();
        if !rest.is_empty() {
            return Err(format!("coded data: expected words of 4 bytes, found {} bytes", bytes.len()));
        }
        let words: Vec<u32> = words.iter().map(|w| u32::from_le_bytes(*w)).collect();
        let Ok(coder) = RangeDecoder::from_compressed(words);
        Ok(Self { coder, beyond: 0 })
    }

    /// Whether all words were read.
    pub(super) fn is_at_end(&self) -> bool {
        self.coder.maybe_exhausted()
    }
}

/// A whole file can be told from one that was cut only by its checksum. This limit stops a decoder whose input is
/// neither: no valid rest of a stream holds more bits after its last word.
const MOST_BEYOND: u64 = 1 << 18;

impl Bits for Reader {
    fn code(&mut self, _: bool, one: u16) -> Result<bool, String> {
        if self.coder.maybe_exhausted() {
            self.beyond += 1;
            if self.beyond > MOST_BEYOND {
                return Err("coded data: ends too early".into());
            }
        }
        self.coder.decode_symbol(Bernoulli { one }).map_err(|e| format!("coded data: {e}"))
    }
}

/// Counts what a [`Writer`] would write.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Meter {
    /// In 1/65536 bit.
    pub cost: u64,
}

/// −log₂ of (k + ½)/4096, in 1/65536 bit, by whole numbers.
static COST: LazyLock<Vec<u32>> = LazyLock::new(|| (0..4096).map(|k| (13 << 16) - log2(2 * k + 1)).collect());

/// log₂ in 1/65536, by repeated squaring.
fn log2(value: u32) -> u32 {
    let whole = value.max(1).ilog2();
    let (mut result, mut mantissa) = (whole << 16, (u64::from(value.max(1)) << 32) >> whole);
    for bit in (0..16).rev() {
        mantissa = ((u128::from(mantissa) * u128::from(mantissa)) >> 32) as u64;
        if mantissa >> 33 != 0 {
            (result, mantissa) = (result | 1 << bit, mantissa >> 1);
        }
    }
    result
}

/// Cost of a bit in 1/65536 bit.
pub(super) fn cost(bit: bool, one: u16) -> u64 {
    let p = if bit { one } else { u16::MAX - one };
    u64::from(COST[usize::from(p >> 4)])
}

impl Bits for Meter {
    fn code(&mut self, bit: bool, one: u16) -> Result<bool, String> {
        self.cost += cost(bit, one);
        Ok(bit)
    }
}

/// What one context knows: the probability that its next bit is 1, and how many bits it saw.
#[derive(Debug, Clone, Copy)]
struct Slot {
    one: u16,
    seen: u8,
}

/// Bits after which a context stops slowing down.
const MEMORY: u8 = 250;
/// Weight of one in the mixer.
const WEIGHT_ONE: i32 = 1 << 16;

/// A mixer of contexts: `inputs` tables of slots and, for each of its selectors, a table of weight sets.
#[derive(Debug, Clone)]
pub(super) struct Mixer {
    inputs: usize,
    slots_of_input: usize,
    slots: Vec<Slot>,
    weights: Vec<i32>,
    uses: Vec<u16>,
}

/// The contexts of one bit.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contexts<'a> {
    /// One slot number for each input.
    pub slots: &'a [usize],
    /// Two weight sets whose opinions are averaged.
    pub sets: [usize; 2],
}

/// Most inputs of a mixer.
const MOST_INPUTS: usize = 12;

struct Opinion {
    one: i32,
    by_set: [i32; 2],
    stretched: [i32; MOST_INPUTS],
}

impl Mixer {
    /// All contexts new, all weights equal.
    pub(super) fn new(inputs: usize, slots_of_input: usize, sets: usize) -> Self {
        let inputs = inputs.min(MOST_INPUTS);
        Self {
            inputs,
            slots_of_input,
            slots: vec![Slot { one: 1 << 15, seen: 0 }; inputs * slots_of_input],
            weights: vec![WEIGHT_ONE * START_WEIGHT / 100; inputs * sets],
            uses: vec![0; sets],
        }
    }

    fn opinion(&self, contexts: Contexts<'_>) -> Opinion {
        let mut stretched = [0; MOST_INPUTS];
        for (input, &slot) in contexts.slots.iter().enumerate().take(self.inputs) {
            let Slot { one, seen } = self.slots[input * self.slots_of_input + slot];
            stretched[input] = (stretch(one) * CONFIDENCE[usize::from(seen.min(15))]) >> 8;
        }
        let by_set = contexts.sets.map(|set| {
            let weights = &self.weights[set * self.inputs..][..self.inputs];
            let sum: i64 = weights.iter().zip(stretched).map(|(&w, s)| i64::from(w) * i64::from(s)).sum();
            (sum >> 16).clamp(-i64::from(LARGEST_STRETCH), i64::from(LARGEST_STRETCH)) as i32
        });
        Opinion { one: squash((by_set[0] + by_set[1]) >> 1), by_set, stretched }
    }

    /// The probability of 1 in 1/65536.
    pub(super) fn predict(&self, contexts: Contexts<'_>) -> u16 {
        self.opinion(contexts).one as u16
    }

    /// Codes a bit and learns from it.
    ///
    /// # Errors
    /// Those of `bits`.
    pub(super) fn code<B: Bits>(&mut self, bits: &mut B, bit: bool, contexts: Contexts<'_>) -> Result<bool, String> {
        let opinion = self.opinion(contexts);
        let bit = bits.code(bit, opinion.one as u16)?;
        let target = if bit { ONE - 1 } else { 0 };
        for (input, &slot) in contexts.slots.iter().enumerate().take(self.inputs) {
            let slot = &mut self.slots[input * self.slots_of_input + slot];
            // A new context starts from what the others thought.
            let from = if slot.seen == 0 { opinion.one } else { i32::from(slot.one) };
            let step = (target - from) * 2 / (2 * i32::from(slot.seen) + FIRST_DIVISOR);
            slot.one = (from + step).clamp(32, ONE - 32) as u16;
            slot.seen = (slot.seen + 1).min(MEMORY);
        }
        for (set, own) in contexts.sets.into_iter().zip(opinion.by_set) {
            let error = i64::from(target - squash(own));
            let uses = &mut self.uses[set];
            *uses = uses.saturating_add(1);
            let rate = i64::from(RATE_LAST + RATE_FIRST / (1 + i32::from(*uses) / RATE_TIME));
            for (weight, &s) in self.weights[set * self.inputs..][..self.inputs].iter_mut().zip(&opinion.stretched) {
                let change = (error * i64::from(s) * rate + (1 << 21)) >> 22;
                *weight = (i64::from(*weight) + change).clamp(-(1 << 20), 1 << 20) as i32;
            }
        }
        Ok(bit)
    }
}

/// Weight of every context before anything is learned, in percent.
const START_WEIGHT: i32 = 17;
/// The first bit moves a context by 2/3 of the way.
const FIRST_DIVISOR: i32 = 3;
/// Speed at which weights are learned, at last and at first.
const RATE_LAST: i32 = 20;
const RATE_FIRST: i32 = 50;
const RATE_TIME: i32 = 64;
/// How far a context that saw 0 … 15 bits is believed, in 1/256.
const CONFIDENCE: [i32; 16] = [0, 110, 150, 175, 190, 200, 208, 214, 220, 224, 228, 232, 236, 240, 244, 256];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probabilities_are_the_logistic_function_and_back() {
        for s in (-2047..=2047).step_by(61) {
            let expected = 65536.0 / (1.0 + (-f64::from(s) / 256.0).exp());
            // Straight lines between 33 points, whose ends are held a little from 0 and 1.
            assert!((f64::from(squash(s)) - expected).abs() < 200.0, "{s}: {} {expected}", squash(s));
        }
        for p in (300..65_300).step_by(500) {
            let back = squash(stretch(p as u16));
            // 4096 steps of probability, and one of log-odds: at most 1/4 · 65536 / 256.
            assert!((back - p).abs() <= 16 + 64, "{p}: {back}");
        }
    }

    #[test]
    fn a_bit_costs_the_logarithm_of_its_probability() {
        for one in [40_u16, 700, 9_000, 32_768, 50_000, 65_000] {
            for bit in [false, true] {
                let p = if bit { f64::from(one) } else { 65_535.0 - f64::from(one) } / 65_536.0;
                let found = cost(bit, one) as f64 / 65_536.0;
                // The probability is that of the middle of one of 4096 steps.
                let most = (1.0 + 9.0 / (65_536.0 * p)).log2() + 1e-3;
                assert!((found + p.log2()).abs() < most, "{bit} {one}: {found} {}", -p.log2());
            }
        }
    }

    #[test]
    fn bits_come_back_and_take_about_what_the_meter_says() {
        let bit = |k: usize| (k * k % 7 == 1) ^ k.is_multiple_of(13);
        let context = |k: usize| [k % 3, 3 + k % 7];
        let run = |bits: &mut dyn FnMut(&mut Mixer, usize) -> bool| {
            let mut mixer = Mixer::new(2, 16, 2);
            (0..4000).map(|k| bits(&mut mixer, k)).collect::<Vec<bool>>()
        };
        let (mut writer, mut meter) = (Writer::default(), Meter::default());
        let asked =
            run(&mut |m, k| m.code(&mut writer, bit(k), Contexts { slots: &context(k), sets: [0, k % 2] }).unwrap());
        run(&mut |m, k| m.code(&mut meter, bit(k), Contexts { slots: &context(k), sets: [0, k % 2] }).unwrap());
        let bytes = writer.finish();
        let mut reader = Reader::new(&bytes).unwrap();
        let found =
            run(&mut |m, k| m.code(&mut reader, false, Contexts { slots: &context(k), sets: [0, k % 2] }).unwrap());
        assert_eq!(found, asked);
        assert!(reader.is_at_end());
        assert_eq!(asked, (0..4000).map(bit).collect::<Vec<_>>());
        // What is learned makes them cheaper than a bit each; costs are rounded to 4096 steps, words end at 8 bytes.
        let (written, metered) = (bytes.len() as f64 * 8.0, meter.cost as f64 / 65_536.0);
        assert!(written < 3600.0 && (written - metered).abs() < 64.0 + 0.01 * metered, "{written} {metered}");
    }
}
