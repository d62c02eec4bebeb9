//! Maps of whole numbers (quantized coefficients, shifts, positions) and text, as bits in context.

use super::entropy::{Bits, Contexts, Meter, Mixer};

/// Magnitudes up to here are counted bit by bit; larger ones continue as an Elias-gamma number.
const UNARY: usize = 14;
/// Bits of an escaped magnitude's length.
const LONGEST: usize = 31;
/// Contexts of one magnitude, each combined with the bit's place in the number.
const INPUTS: usize = 8;
const CONTEXTS: usize = 1 << 10;
const BINS: usize = UNARY;
const SIGN_INPUTS: usize = 4;

/// Maps that were coded before and resemble this one: the same place of the last but one, and so on.
pub(super) type Earlier<'a> = [Option<&'a [i32]>; 3];

/// What is learned about the whole numbers of one kind of map.
#[derive(Debug, Clone)]
pub(super) struct Numbers {
    magnitude: Mixer,
    sign: Mixer,
    escape: Mixer,
}

/// The surroundings of one number.
struct Around {
    contexts: [usize; INPUTS],
    set: usize,
    signs: [usize; SIGN_INPUTS],
}

/// 0, 1, 2, 3, then two steps an octave; at most 23.
fn level(value: u32) -> usize {
    match value {
        0..4 => value as usize,
        _ => {
            let octave = value.ilog2();
            (2 * octave as usize + ((value >> (octave - 1)) & 1) as usize).min(23)
        }
    }
}

/// The map while it is coded: what came before the present place is known.
struct Known<'a> {
    size: [usize; 2],
    current: &'a [i32],
    earlier: Earlier<'a>,
}

impl Known<'_> {
    fn here(&self, x: usize, y: usize, left: isize, up: isize) -> i32 {
        get(self.current, self.size, x as isize - left, y as isize - up)
    }

    fn before(&self, k: usize, x: usize, y: usize) -> i32 {
        self.earlier[k].map_or(0, |map| get(map, self.size, x as isize, y as isize))
    }

    fn around_before(&self, k: usize, x: usize, y: usize) -> u32 {
        let Some(map) = self.earlier[k] else { return 0 };
        let (x, y) = (x as isize, y as isize);
        let near = [(1, 0), (-1, 0), (0, 1), (0, -1)];
        near.iter().map(|(dx, dy)| get(map, self.size, x + dx, y + dy).unsigned_abs().min(1 << 20)).sum()
    }

    fn around(&self, x: usize, y: usize) -> Around {
        let near = [(1, 0), (0, 1), (1, 1), (-1, 1), (2, 0), (0, 2)].map(|(l, u)| self.here(x, y, l, u));
        let [left, up, upper_left, upper_right, left2, up2] = near.map(|v| v.unsigned_abs().min(1 << 20));
        let [one, two, sibling] = [0, 1, 2].map(|k| self.before(k, x, y).unsigned_abs().min(1 << 20));
        let ring = self.around_before(0, x, y);
        let ring_sibling = self.around_before(2, x, y);
        let parent =
            if x + y > 0 { self.here(x, y, (x - x / 2) as isize, (y - y / 2) as isize).unsigned_abs() } else { 0 };
        let local = 2 * (left + up) + upper_left + upper_right + left2 + up2;
        let temporal = 2 * one + two + ring / 4;
        let clip = |v: u32, most: u32| v.min(most) as usize;
        let place = |v: usize| level(v as u32).min(15);
        let wide: u32 = (1..=3)
            .flat_map(|u| (-3..=3).map(move |l| (l, u)))
            .chain([(1, 0), (2, 0), (3, 0)])
            .map(|(l, u)| u32::from(self.here(x, y, l, u) != 0))
            .sum();
        let contexts = [
            level(local) * 24 + level(one + sibling).min(7),
            level(2 * one + two) * 24 + level(ring),
            place(y) * 16 + place(x),
            level(local * 2 + temporal * 2 + 3 * sibling),
            (((clip(left, 2) * 3 + clip(up, 2)) * 3 + clip(one, 2)) * 3 + clip(sibling, 2)) * 3 + clip(two, 2),
            (level(parent.min(1 << 20)).min(9) * 8 + level(sibling).min(7)) * 8 + level(ring).min(7),
            clip(wide, 24) * 24 + level(temporal + sibling),
            level(2 * sibling + ring_sibling) * 24 + level(local).min(23),
        ];
        let sign = |v: i32| (v.signum() + 1) as usize;
        let before = |k: usize| sign(self.before(k, x, y));
        let edge = usize::from(x == 0) * 2 + usize::from(y == 0);
        let signs = [
            sign(near[0]) * 3 + sign(near[1]),
            before(0) * 3 + before(2) + 9 * before(1),
            (edge * 3 + sign(near[2])) * 3 + sign(near[3]),
            (sign(near[0]) * 3 + sign(near[1])) * 9 + before(0) * 3 + before(2),
        ];
        Around { contexts, set: level(local + temporal + sibling).min(11), signs }
    }
}

fn get(map: &[i32], size: [usize; 2], x: isize, y: isize) -> i32 {
    let inside = x >= 0 && y >= 0 && (x as usize) < size[0] && (y as usize) < size[1];
    if inside { map.get(x as usize + y as usize * size[0]).copied().unwrap_or(0) } else { 0 }
}

impl Numbers {
    /// Nothing is known yet.
    pub(super) fn new() -> Self {
        Self {
            magnitude: Mixer::new(INPUTS, CONTEXTS * BINS, BINS + 12 * 3),
            sign: Mixer::new(SIGN_INPUTS, 128, 1),
            escape: Mixer::new(1, 2 * LONGEST + 2, 1),
        }
    }

    /// Codes a whole map of `size` (x, y), row by row. `choose` gives each number when it is its turn, and may weigh
    /// what each costs; a decoder gets 0 from it.
    ///
    /// # Errors
    /// Those of `bits`.
    pub(super) fn code_map<B: Bits>(
        &mut self,
        bits: &mut B,
        size: [usize; 2],
        earlier: Earlier<'_>,
        mut choose: impl FnMut(usize, &dyn Fn(i32) -> u64) -> i32,
    ) -> Result<Vec<i32>, String> {
        let mut current = Vec::new();
        for y in 0..size[1] {
            // A row at a time: what a broken file asks for is not allocated before its bits have been read.
            current.resize(current.len() + size[0], 0);
            for x in 0..size[0] {
                let known = Known { size, current: &current, earlier };
                let around = known.around(x, y);
                let at = x + y * size[0];
                let value = choose(at, &|value| self.cost(&around, value));
                current[at] = self.code(bits, &around, value)?;
            }
        }
        Ok(current)
    }

    fn magnitude_bit<B: Bits>(&mut self, bits: &mut B, around: &Around, bin: usize, bit: bool) -> Result<bool, String> {
        let (slots, sets) = magnitude_contexts(around, bin);
        self.magnitude.code(bits, bit, Contexts { slots: &slots, sets })
    }

    /// Cost of a number in 1/65536 bit, should it come next.
    fn cost(&self, around: &Around, value: i32) -> u64 {
        let magnitude = value.unsigned_abs() as usize;
        let mut total = 0;
        for bin in 0..=magnitude.min(UNARY - 1) {
            let (slots, sets) = magnitude_contexts(around, bin);
            let one = self.magnitude.predict(Contexts { slots: &slots, sets });
            total += super::entropy::cost(bin < magnitude, one);
        }
        let escape = if magnitude >= UNARY { 2 * (magnitude - UNARY + 1).ilog2() as u64 + 1 } else { 0 };
        let sign = u64::from(value != 0);
        total + ((escape + sign) << 16)
    }

    fn code<B: Bits>(&mut self, bits: &mut B, around: &Around, value: i32) -> Result<i32, String> {
        let asked = value.unsigned_abs() as usize;
        let mut magnitude = 0;
        while magnitude < UNARY && self.magnitude_bit(bits, around, magnitude, magnitude < asked)? {
            magnitude += 1;
        }
        if magnitude == 0 {
            return Ok(0);
        }
        if magnitude == UNARY {
            magnitude += self.code_escape(bits, asked.saturating_sub(UNARY) as u32)? as usize;
        }
        let negative = self.sign.code(bits, value < 0, Contexts { slots: &around.signs, sets: [0, 0] })?;
        let magnitude = i32::try_from(magnitude).map_err(|_| "coded data: a number is too large".to_owned())?;
        Ok(if negative { -magnitude } else { magnitude })
    }

    /// `value` + 1 by Elias: its length in ones, then its bits below the first.
    fn code_escape<B: Bits>(&mut self, bits: &mut B, value: u32) -> Result<u32, String> {
        let asked = u64::from(value) + 1;
        let mut length = 0;
        loop {
            let slots = [length];
            let more = length < asked.ilog2() as usize;
            if !self.escape.code(bits, more, Contexts { slots: &slots, sets: [0, 0] })? {
                break;
            }
            length += 1;
            if length > LONGEST - 1 {
                return Err("coded data: a number is too large".into());
            }
        }
        let mut found = 1_u64;
        for k in (0..length).rev() {
            let bit = asked >> k & 1 == 1;
            let first = k + 1 == length;
            let bit = if first {
                self.escape.code(bits, bit, Contexts { slots: &[LONGEST + length], sets: [0, 0] })?
            } else {
                bits.code(bit, 1 << 15)?
            };
            found = found << 1 | u64::from(bit);
        }
        u32::try_from(found - 1).map_err(|_| "coded data: a number is too large".to_owned())
    }
}

fn magnitude_contexts(around: &Around, bin: usize) -> ([usize; INPUTS], [usize; 2]) {
    (around.contexts.map(|c| (c % CONTEXTS) * BINS + bin), [bin, BINS + around.set * 3 + bin.min(2)])
}

/// What a map costs, in 1/65536 bit, and its numbers; nothing is learned.
pub(super) fn try_map(
    numbers: &Numbers,
    size: [usize; 2],
    earlier: Earlier<'_>,
    choose: impl FnMut(usize, &dyn Fn(i32) -> u64) -> i32,
) -> (u64, Vec<i32>) {
    let mut meter = Meter::default();
    let map = numbers.clone().code_map(&mut meter, size, earlier, choose).unwrap_or_default();
    (meter.cost, map)
}

#[cfg(test)]
mod tests {
    use super::super::entropy::{Reader, Writer};
    use super::*;

    #[test]
    fn numbers_of_any_size_and_sign_come_back_in_their_places() {
        let size = [5, 4];
        let large = [0, 1, -1, 13, -14, 15, 14, -300, 1 << 20, -(1 << 24), 16, 2, 0, 0, -7, 28, 29, 30, -31, 1 << 30];
        let small: Vec<i32> = (0..20).map(|k| (k * 7 % 5) - 2).collect();
        let mut w = Writer::default();
        let mut numbers = Numbers::new();
        assert_eq!(numbers.code_map(&mut w, size, [None; 3], |at, _| large[at]).unwrap(), large);
        numbers.code_map(&mut w, size, [Some(&large), None, Some(&small)], |at, _| small[at]).unwrap();
        let mut r = Reader::new(&w.finish()).unwrap();
        let mut numbers = Numbers::new();
        assert_eq!(numbers.code_map(&mut r, size, [None; 3], |_, _| 0).unwrap(), large);
        let found = numbers.code_map(&mut r, size, [Some(&large), None, Some(&small)], |_, _| 0).unwrap();
        assert_eq!(found, small);
        assert!(r.is_at_end());
    }

    #[test]
    fn what_is_around_a_place_is_read_from_its_own_neighbours() {
        // 4 × 3 around (2, 1): left 7, above 3, upper left −5, upper right 0.
        let current = [1, -5, 3, 0, 2, 7];
        let before: Vec<i32> = (0..12).map(|k| k - 6).collect();
        let known = Known { size: [4, 3], current: &current, earlier: [Some(&before), None, None] };
        let at = |l, u| known.here(2, 1, l, u);
        assert_eq!([at(1, 0), at(0, 1), at(1, 1), at(-1, 1), at(2, 0), at(0, 2), at(-2, 1)], [7, 3, -5, 0, 2, 0, 0]);
        assert_eq!((known.before(0, 2, 1), known.before(1, 2, 1)), (0, 0));
        assert_eq!(known.before(0, 3, 2), 5);
        // Of −6 … 5 in lines of four: 1, −1, 4 and −4 around (2, 1), three at a rim.
        assert_eq!(known.around_before(0, 2, 1), 10);
        assert_eq!(known.around_before(0, 0, 0), 5 + 2);
        assert_eq!(known.around_before(2, 2, 1), 0);
        assert_eq!([0, 1, 3, 4, 5, 6, 7, 8, 12, 1 << 20].map(level), [0, 1, 3, 4, 4, 5, 5, 6, 7, 23]);
    }

    #[test]
    fn a_map_that_is_tried_costs_what_writing_it_takes() {
        let size = [16, 12];
        let map: Vec<i32> = (0..192).map(|k: i32| (k * k % 11) - 5 + if k % 50 == 0 { 40 } else { 0 }).collect();
        let (cost, tried) = try_map(&Numbers::new(), size, [None; 3], |at, _| map[at]);
        assert_eq!(tried, map);
        let mut w = Writer::default();
        Numbers::new().code_map(&mut w, size, [None; 3], |at, _| map[at]).unwrap();
        let (written, tried) = (w.finish().len() as f64 * 8.0, cost as f64 / 65_536.0);
        assert!((written - tried).abs() < 64.0 + 0.01 * tried, "words and 4096 steps: {written} {tried}");
    }
}
