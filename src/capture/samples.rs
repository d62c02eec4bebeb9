//! Decoded code values, and where in its pixel each was measured.

/// Decoded code values, R G B interleaved.
#[derive(Debug, Clone, PartialEq)]
pub struct Pixels {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// 3 · width · height code values.
    pub samples: Samples,
    /// Where in its pixel each channel was measured.
    pub sampling: Sampling,
}

/// Where in its pixel, and over how much of it, each channel (R, G, B) was measured.
///
/// All of it, unless the photograph is a mosaic that was read at half size: then R and B were measured by one photosite
/// of four.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sampling {
    /// Centre of the light that was measured, from the pixel's centre, px (x right, y down).
    pub offset_px: [[f64; 2]; 3],
    /// Side of the square over which it was averaged, px. The two G of a block, corner to corner, count as the whole of
    /// it.
    pub aperture_px: [f64; 3],
    /// Variance over that of one photosite with the same code value: ½ for a mean of two.
    pub variance_share: [f32; 3],
}

impl Sampling {
    /// Every channel over the whole pixel.
    pub const WHOLE: Self = Self { offset_px: [[0.0; 2]; 3], aperture_px: [1.0; 3], variance_share: [1.0; 3] };
}

/// Code values in the file's own type.
#[derive(Debug, Clone, PartialEq)]
pub enum Samples {
    /// 8-bit.
    U8(Vec<u8>),
    /// 16-bit (or fewer bits in 16).
    U16(Vec<u16>),
    /// Floating point, linear.
    F32(Vec<f32>),
}

/// A rectangle of camera pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Rect {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Rect {
    /// Number of pixels.
    pub fn area(&self) -> usize {
        self.width * self.height
    }
}

impl Samples {
    /// Number of code values.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        match self {
            Self::U8(v) => v.len(),
            Self::U16(v) => v.len(),
            Self::F32(v) => v.len(),
        }
    }

    /// Bytes that they take.
    pub(super) fn bytes(&self) -> usize {
        match self {
            Self::U8(v) => v.len(),
            Self::U16(v) => 2 * v.len(),
            Self::F32(v) => 4 * v.len(),
        }
    }

    /// Shows `see` each code value.
    pub(crate) fn for_each(&self, mut see: impl FnMut(f64)) {
        match self {
            Self::U8(v) => v.iter().for_each(|&c| see(f64::from(c))),
            Self::U16(v) => v.iter().for_each(|&c| see(f64::from(c))),
            Self::F32(v) => v.iter().for_each(|&c| see(f64::from(c))),
        }
    }

    /// Makes these 8-bit code values, which `fill` puts into an empty vector.
    pub(super) fn refill_u8(&mut self, fill: impl FnOnce(&mut Vec<u8>)) {
        let old = if let Self::U8(v) = self { std::mem::take(v) } else { vec![] };
        *self = Self::U8(refilled(old, fill));
    }

    /// Makes these 16-bit code values, which `fill` puts into an empty vector.
    pub(super) fn refill_u16(&mut self, fill: impl FnOnce(&mut Vec<u16>)) {
        let old = if let Self::U16(v) = self { std::mem::take(v) } else { vec![] };
        *self = Self::U16(refilled(old, fill));
    }

    /// Makes these floating point code values, which `fill` puts into an empty vector.
    pub(super) fn refill_f32(&mut self, fill: impl FnOnce(&mut Vec<f32>)) {
        let old = if let Self::F32(v) = self { std::mem::take(v) } else { vec![] };
        *self = Self::F32(refilled(old, fill));
    }

    /// No code values, in the memory that they had.
    pub(crate) fn clear(&mut self) {
        match self {
            Self::U8(v) => v.clear(),
            Self::U16(v) => v.clear(),
            Self::F32(v) => v.clear(),
        }
    }

    /// Appends some code values of `from`, whose type this becomes when it is empty; of another type than before
    /// nothing is kept.
    pub(crate) fn extend(&mut self, from: &Self, range: std::ops::Range<usize>) {
        match (&mut *self, from) {
            (Self::U8(to), Self::U8(from)) => to.extend_from_slice(&from[range]),
            (Self::U16(to), Self::U16(from)) => to.extend_from_slice(&from[range]),
            (Self::F32(to), Self::F32(from)) => to.extend_from_slice(&from[range]),
            (_, Self::U8(from)) => *self = Self::U8(from[range].to_vec()),
            (_, Self::U16(from)) => *self = Self::U16(from[range].to_vec()),
            (_, Self::F32(from)) => *self = Self::F32(from[range].to_vec()),
        }
    }

    /// Three planes, each of whose code values is there three times, as the colours of one picture; `None` when they
    /// differ in type or length.
    pub(super) fn of_planes(planes: &[Self]) -> Option<Self> {
        fn of<T: Copy>([r, g, b]: [&[T]; 3]) -> Option<Vec<T>> {
            let all = r.iter().zip(g).zip(b).step_by(3).flat_map(|((&r, &g), &b)| [r, g, b]).collect();
            (r.len() == g.len() && g.len() == b.len()).then_some(all)
        }
        match planes {
            [Self::U8(r), Self::U8(g), Self::U8(b)] => of([r, g, b]).map(Self::U8),
            [Self::U16(r), Self::U16(g), Self::U16(b)] => of([r, g, b]).map(Self::U16),
            [Self::F32(r), Self::F32(g), Self::F32(b)] => of([r, g, b]).map(Self::F32),
            _ => None,
        }
    }

    /// A copy of the code values in `part` of the rectangle `whole` that these are; `part` must lie inside.
    pub fn crop(&self, whole: Rect, part: Rect) -> Self {
        fn rows<T: Copy>(v: &[T], whole: Rect, part: Rect) -> Vec<T> {
            let mut out = Vec::with_capacity(3 * part.area());
            for y in part.y - whole.y..part.y - whole.y + part.height {
                out.extend_from_slice(&v[3 * (y * whole.width + part.x - whole.x)..][..3 * part.width]);
            }
            out
        }
        match self {
            Self::U8(v) => Self::U8(rows(v, whole, part)),
            Self::U16(v) => Self::U16(rows(v, whole, part)),
            Self::F32(v) => Self::F32(rows(v, whole, part)),
        }
    }
}

/// What `fill` puts into the memory of `values`.
fn refilled<T>(mut values: Vec<T>, fill: impl FnOnce(&mut Vec<T>)) -> Vec<T> {
    values.clear();
    fill(&mut values);
    values
}
