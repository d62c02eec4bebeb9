//! Where the samples of a row lie on the window that all rows share.

use std::ops::Range;

/// A measured window and the common one on which shifted rows lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// Samples that were measured, along x and y; odd.
    pub window: [usize; 2],
    /// Samples of the common window, odd: `window` + 2 · the largest shift, or fewer where the rim has nothing to
    /// model.
    pub extended: [usize; 2],
}

impl Layout {
    /// Samples of the common window.
    pub fn len(&self) -> usize {
        self.extended[0] * self.extended[1]
    }

    /// Whether the common window has no samples.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// How far sample `a` of a window shifted by `shift` lies from sample `a` of the common window, along each axis.
    fn lead(&self, shift: [i16; 2]) -> [isize; 2] {
        std::array::from_fn(|a| (self.extended[a] / 2) as isize - (self.window[a] / 2) as isize - isize::from(shift[a]))
    }

    /// Linear index on the common window of window sample (x, y) of a row shifted by `shift`; `None` outside it.
    pub fn index(&self, shift: [i16; 2], sample: [usize; 2]) -> Option<usize> {
        let lead = self.lead(shift);
        let at = |a: usize| usize::try_from(sample[a] as isize + lead[a]).ok().filter(|&e| e < self.extended[a]);
        Some(at(0)? + at(1)? * self.extended[0])
    }

    /// Calls `each(window_index, extended_index, length)` for every line of a window shifted by `shift`, as far as it
    /// lies on the common window: `length` samples along x from there.
    pub fn for_each_line(&self, shift: [i16; 2], mut each: impl FnMut(usize, usize, usize)) {
        let lead = self.lead(shift);
        let range = |a: usize| {
            let first = usize::try_from(-lead[a]).unwrap_or(0).min(self.window[a]);
            let end = usize::try_from(self.extended[a] as isize - lead[a]).unwrap_or(0).min(self.window[a]);
            first..end.max(first)
        };
        let (x, y) = (range(0), range(1));
        if x.is_empty() {
            return;
        }
        for dy in y {
            if let Some(e) = self.index(shift, [x.start, dy]) {
                each(x.start + dy * self.window[0], e, x.len());
            }
        }
    }

    /// Calls `each(window_index, extended_index)` for every sample of a window shifted by `shift` that lies on the
    /// common window.
    pub fn for_each(&self, shift: [i16; 2], mut each: impl FnMut(usize, usize)) {
        self.for_each_line(shift, |k, e, length| (0..length).for_each(|x| each(k + x, e + x)));
    }
}

/// A part of the common window: columns and lines.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Core {
    pub(crate) x: Range<usize>,
    pub(crate) y: Range<usize>,
}

impl Core {
    /// What windows whose shifts lie between `least` and `most` have in common; `None` when that is nothing.
    pub(crate) fn of(layout: &Layout, least: [i16; 2], most: [i16; 2]) -> Option<Self> {
        let side = |a: usize| {
            let (first, end) = (layout.lead(least)[a], layout.lead(most)[a] + layout.window[a] as isize);
            let held = |at: isize| at.clamp(0, layout.extended[a] as isize) as usize;
            held(first)..held(end)
        };
        let core = Self { x: side(0), y: side(1) };
        (!core.x.is_empty() && !core.y.is_empty()).then_some(core)
    }

    pub(crate) fn samples(&self) -> usize {
        self.x.len() * self.y.len()
    }

    /// Whether sample `e` of a common window of `width` columns is in it.
    pub(crate) fn contains(&self, width: usize, e: usize) -> bool {
        self.y.contains(&(e / width.max(1))) && self.x.contains(&(e % width.max(1)))
    }

    /// How far its first sample lies from the lit point of a row shifted by `shift`, in samples.
    pub(crate) fn offset_from_lit(&self, layout: &Layout, shift: [i16; 2]) -> [isize; 2] {
        let first = [self.x.start, self.y.start];
        std::array::from_fn(|a| first[a] as isize - (layout.extended[a] / 2) as isize + isize::from(shift[a]))
    }

    /// Its samples before sample `e` of a common window of `width` columns.
    pub(crate) fn before(&self, width: usize, e: usize) -> usize {
        let (x, y) = (e % width.max(1), e / width.max(1));
        let lines = y.clamp(self.y.start, self.y.end) - self.y.start;
        let here = if self.y.contains(&y) { x.clamp(self.x.start, self.x.end) - self.x.start } else { 0 };
        lines * self.x.len() + here
    }

    /// Calls `each(skipped, length)` for what `length` samples along x from sample `e` of a common window of `width`
    /// columns on have outside.
    pub(crate) fn outside(&self, width: usize, e: usize, length: usize, mut each: impl FnMut(usize, usize)) {
        let (x, y) = (e % width.max(1), e / width.max(1));
        if !self.y.contains(&y) {
            return each(0, length);
        }
        let before = self.x.start.saturating_sub(x).min(length);
        let after = (x + length).saturating_sub(self.x.end).min(length);
        if before > 0 {
            each(0, before);
        }
        if after > 0 {
            each(length - after, after);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_core_is_what_all_windows_have_and_what_is_outside_is_the_rest() {
        let layout = Layout { window: [7, 5], extended: [13, 9] };
        let shifts = [[-1, 0], [2, 1], [0, -1], [1, 1]];
        let core = Core::of(&layout, [-1, -1], [2, 1]).unwrap();
        let samples = |shift| {
            let mut all = Vec::new();
            layout.for_each(shift, |_, e| all.push(e));
            all
        };
        let common: Vec<usize> =
            samples(shifts[0]).into_iter().filter(|e| shifts.iter().all(|&s| samples(s).contains(e))).collect();
        let inside: Vec<usize> = core.y.clone().flat_map(|y| core.x.clone().map(move |x| 13 * y + x)).collect();
        assert_eq!((&common, core.samples()), (&inside, common.len()));
        for shift in shifts {
            let mut outside = Vec::new();
            layout.for_each_line(shift, |_, e, n| {
                core.outside(13, e, n, |skipped, n| outside.extend(e + skipped..e + skipped + n));
            });
            let before = |e: usize| inside.iter().filter(|&&i| i < e).count();
            assert!(outside.iter().all(|&e| core.before(13, e) == before(e)));
            let mut both = [outside, inside.clone()].concat();
            both.sort_unstable();
            assert_eq!(both, samples(shift));
            // Sample e of the common window is offset e − half + shift from the lit point.
            let [x, y] = core.offset_from_lit(&layout, shift);
            let from = layout.index(shift, [(x + 3) as usize, (y + 2) as usize]);
            assert_eq!(from, Some(core.x.start + 13 * core.y.start));
        }
        assert_eq!(Core::of(&layout, [-4, 0], [4, 0]), None, "seven columns, eight apart");
    }
}
