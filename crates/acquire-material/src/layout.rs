//! Where the samples of a row lie on the window that all rows share.

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
