//! Photon transfer: the sensor's noise from photographs of one scene, taken twice.
//!
//! Where two photographs of one exposure show the same light, half the variance of their difference is that of the
//! sensor alone: what differs from photosite to photosite cancels. Against the mean it is a line whose slope is the
//! gain (DN per electron) and whose height at the black level is the read noise (`Janesick2007`).

use crate::capture::{Noise, Samples};

/// Side of the blocks over which variances are taken, px: small against stripes, large enough for a variance to a
/// fifth.
const BLOCK_PX: usize = 8;
/// Degrees of freedom that a plane leaves in a block.
const FREEDOM: f64 = (BLOCK_PX * BLOCK_PX - 3) as f64;
/// The fewest blocks in light, and dark, that are worth a fit.
const LEAST_BLOCKS: usize = 30;
/// Exposure times of one bracket are relied upon to this share: nominal shutter times err by as much.
const SHUTTER_ERROR: f64 = 0.02;
/// Mean levels are not relied upon beyond this, DN: converters are not that even.
const LEVEL_ERROR_DN: f64 = 0.02;
/// Where a sensor that clips at its largest code is taken for linear up to, of that code.
const LINEAR_UP_TO: f64 = 0.98;

/// A noise model from photographs, with standard deviations.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct NoiseEstimate {
    /// The model.
    pub noise: Noise,
    /// Of the gain, DN per electron.
    pub gain_sd: f64,
    /// Of the read noise, electrons.
    pub read_noise_sd: f64,
    /// Of the black level, DN.
    pub black_sd: f64,
    /// Whether photosites were seen that clip; without any, saturation is just above the largest code that was seen.
    pub saturation_seen: bool,
    /// Blocks of pixels that the gain comes from.
    pub blocks: usize,
    /// Gain of R, G, B alone and its standard deviation, DN per electron ([`channel_gains`]); `None` when it was not
    /// asked for.
    #[serde(default)]
    pub channel_gains: Option<[[f64; 2]; 3]>,
}

/// Mean and variance of a block of pixels that two photographs show alike.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Block {
    /// Mean code value, DN.
    pub mean: f64,
    /// Variance of one photograph's code values, DN².
    pub variance: f64,
}

/// The blocks of two photographs of one exposure and size that do not saturate, per channel; R G B interleaved, `width`
/// px wide.
///
/// The variance is half that of the difference, a plane over the block taken out. Blocks in which the two photographs
/// show different light (stripes, their blur) have far too large ones; [`fit`] leaves them out. `None` stands for a
/// block that saturates, holds code 0, or whose two levels differ by a tenth and more, so that neighbours can be told:
/// blocks are row by row, three channels each. `variance_share` is that of [`crate::capture::Sampling`].
///
/// Not detected: photographs whose noise was smoothed or is correlated between pixels (demosaiced, compressed): too
/// small a variance.
pub fn blocks(
    [first, second]: [&Samples; 2],
    width: usize,
    black_dn: f64,
    saturation_dn: f64,
    variance_share: [f32; 3],
) -> BlockGrid {
    // Whole numbers stop at 0, and with them the noise; floating point does not.
    let least = if matches!(first, Samples::F32(_)) { f64::NEG_INFINITY } else { 0.0 };
    let code = |s: &Samples, k: usize| match s {
        Samples::U8(v) => f64::from(v[k]),
        Samples::U16(v) => f64::from(v[k]),
        Samples::F32(v) => f64::from(v[k]),
    };
    let len = |s: &Samples| match s {
        Samples::U8(v) => v.len(),
        Samples::U16(v) => v.len(),
        Samples::F32(v) => v.len(),
    };
    let height = len(first).min(len(second)) / (3 * width).max(1);
    let size = [width / BLOCK_PX, height / BLOCK_PX];
    let mut found = Vec::with_capacity(3 * size[0] * size[1]);
    for by in 0..size[1] {
        for bx in 0..size[0] {
            for c in 0..3 {
                let at = |i: usize| 3 * ((by * BLOCK_PX + i / BLOCK_PX) * width + bx * BLOCK_PX + i % BLOCK_PX) + c;
                found.push(
                    block(|i| [code(first, at(i)), code(second, at(i))], black_dn, least..saturation_dn)
                        .map(|b| Block { variance: b.variance / f64::from(variance_share[c]), ..b }),
                );
            }
        }
    }
    BlockGrid { size, blocks: found }
}

/// The blocks of a pair of photographs, where they lie.
#[derive(Debug, Clone)]
pub struct BlockGrid {
    size: [usize; 2],
    blocks: Vec<Option<Block>>,
}

impl BlockGrid {
    /// The same less a variance that is not the sensor's, of a mean and channel: that of the files.
    pub fn without(mut self, variance: impl Fn(f64, usize) -> f64) -> Self {
        for (k, block) in self.blocks.iter_mut().enumerate() {
            if let Some(b) = block {
                b.variance = (b.variance - variance(b.mean, k % 3)).max(0.0);
            }
        }
        self
    }

    /// The blocks of one channel in the place of all three.
    fn channel(&self, channel: usize) -> Self {
        let blocks = self.blocks.chunks(3).flat_map(|b| [b[channel]; 3]).collect();
        Self { size: self.size, blocks }
    }
}

/// Gain of each channel and its standard deviation, DN per electron; the arguments are those of [`fit`]. `None` where
/// one has too few blocks.
pub fn channel_gains(
    grids: &[BlockGrid],
    black: (f64, f64),
    saturation: (f64, bool),
    rounding: f64,
) -> Option<[[f64; 2]; 3]> {
    let gain = |c: usize| {
        let own: Vec<BlockGrid> = grids.iter().map(|g| g.channel(c)).collect();
        // Each block counts three times.
        fit(&own, black, saturation, rounding).ok().map(|e| [e.noise.gain_dn_per_electron, 3f64.sqrt() * e.gain_sd])
    };
    Some([gain(0)?, gain(1)?, gain(2)?])
}

/// `pixel` gives both code values of pixel i, row by row.
fn block(pixel: impl Fn(usize) -> [f64; 2], black_dn: f64, range: std::ops::Range<f64>) -> Option<Block> {
    let n = BLOCK_PX * BLOCK_PX;
    // Sums of the difference against 1, x and y, which are orthogonal over a centred block.
    let (mut sum, mut moments, mut square) = (0.0, [0.0; 3], 0.0);
    let middle = (BLOCK_PX as f64 - 1.0) / 2.0;
    for i in 0..n {
        let [a, b] = pixel(i);
        // NaN fails too.
        if !(a > range.start && b > range.start && a < range.end && b < range.end) {
            return None;
        }
        let d = a - b;
        let (x, y) = ((i % BLOCK_PX) as f64 - middle, (i / BLOCK_PX) as f64 - middle);
        sum += a + b;
        square += d * d;
        moments = [moments[0] + d, moments[1] + d * x, moments[2] + d * y];
    }
    let per_axis = n as f64 * (BLOCK_PX * BLOCK_PX - 1) as f64 / 12.0;
    let plane = moments[0].powi(2) / n as f64 + (moments[1].powi(2) + moments[2].powi(2)) / per_axis;
    let block = Block { mean: sum / (2 * n) as f64, variance: (square - plane).max(0.0) / (2.0 * FREEDOM) };
    // With different light the photosites' own differences would not cancel.
    let sd = (2.0 * block.variance / n as f64).sqrt();
    let same = (moments[0] / n as f64).abs() <= 0.1 * (block.mean - black_dn).max(0.0) + 5.0 * sd;
    same.then_some(block)
}

/// Mean code values of the exposures of one black shot: (exposure time in s, DN).
pub type DarkLevels = Vec<(f64, f64)>;

/// Black level and its standard deviation: the code value that exposures of a black shot tend to at no time.
///
/// Each shot has its own light, in proportion to time; the level is common. `None` when no shot has two exposures.
///
/// Not detected: light or dark current that is not in proportion to the exposure time.
pub fn black_level(shots: &[DarkLevels]) -> Option<(f64, f64)> {
    let mut black = shots.iter().flatten().map(|l| l.1).fold(f64::INFINITY, f64::min);
    let mut information = 0.0;
    // The weights depend a little on the level itself.
    for _ in 0..4 {
        let mut pull = 0.0;
        information = 0.0;
        for shot in shots {
            let mut s = [0.0f64; 5];
            for &(t, y) in shot {
                let w = 1.0 / (LEVEL_ERROR_DN.powi(2) + (SHUTTER_ERROR * (y - black)).powi(2));
                s = [s[0] + w, s[1] + w * t, s[2] + w * t * t, s[3] + w * y, s[4] + w * t * y];
            }
            if shot.len() > 1 && s[2] > 0.0 {
                information += s[0] - s[1] * s[1] / s[2];
                pull += s[3] - s[1] * s[4] / s[2];
            }
        }
        if !(information > 0.0) {
            return None;
        }
        black = pull / information;
    }
    Some((black, information.sqrt().recip()))
}

/// Where codes pile up because photosites clip, from a histogram of the code values of each channel: the least such
/// code.
///
/// A pile holds 16 at least, and eight times what the codes of the hundredth below it do on average.
pub fn clipping_code(histograms: &[Vec<u32>; 3]) -> Option<usize> {
    let of_channel = |h: &Vec<u32>| {
        let top = h.iter().rposition(|&n| n > 0)?;
        let below = top / 100;
        let mean = h[top - below..top].iter().map(|&n| f64::from(n)).sum::<f64>() / below.max(1) as f64;
        (below > 0 && h[top] >= 16 && f64::from(h[top]) > 8.0 * mean).then_some(top)
    };
    histograms.iter().filter_map(of_channel).min()
}

/// Saturation from the clipping code, or from the largest code that occurs: (DN, whether clipping was seen).
pub fn saturation(histograms: &[Vec<u32>; 3]) -> (f64, bool) {
    match clipping_code(histograms) {
        Some(code) => ((code as f64 * LINEAR_UP_TO).round(), true),
        None => {
            (histograms.iter().filter_map(|h| h.iter().rposition(|&n| n > 0)).max().unwrap_or(0) as f64 + 1.0, false)
        }
    }
}

/// Fits the line of variance over mean to the blocks of pairs of photographs.
///
/// `black` is (DN, its standard deviation), `saturation` (DN, whether it was seen), `rounding` the variance of
/// rounding: 1/12 DN² for whole code values, 0 for floating point, whose rounding counts as read noise.
///
/// # Errors
/// What is missing, in words: too few blocks in light or near black.
pub fn fit(
    grids: &[BlockGrid],
    black: (f64, f64),
    saturation: (f64, bool),
    rounding: f64,
) -> Result<NoiseEstimate, String> {
    let seen: Vec<Block> = grids.iter().flat_map(|g| g.blocks.iter().flatten().copied()).collect();
    let brightest = seen.iter().map(|b| b.mean - black.0).fold(0.0, f64::max);
    let median = |range: std::ops::Range<f64>| {
        let mut inside: Vec<Block> = seen.iter().filter(|b| range.contains(&(b.mean - black.0))).copied().collect();
        inside.sort_by(|a, b| a.variance.total_cmp(&b.variance));
        let place = range.start.max(0.0) / brightest.max(1e-9);
        let found = (inside.len() >= LEAST_BLOCKS).then(|| inside[inside.len() / 2]);
        found.ok_or_else(|| {
            let blocks = inside.len();
            format!("{blocks} blocks of {BLOCK_PX} × {BLOCK_PX} px at {place:.1} of the brightest level that two photographs of one exposure share; {LEAST_BLOCKS} are needed")
        })
    };
    // Stripes differ in half the blocks at most: medians are safe to start from.
    let (lit, dark) = (median(0.3 * brightest..f64::INFINITY)?, median(f64::NEG_INFINITY..0.05 * brightest)?);
    let slope = ((lit.variance - dark.variance) / (lit.mean - dark.mean)).max(0.0);
    let mut line =
        Line { at_black: (dark.variance - slope * (dark.mean - black.0)).max(1e-3), slope, ..Line::default() };
    for _ in 0..6 {
        line = line.refit(grids, black.0).ok_or("no blocks remain beside the edges of the stripes")?;
    }
    let noise_of = |line: &Line| {
        let gain = line.slope.max(0.0);
        let read = (line.at_black - rounding).max(0.0).sqrt();
        (gain, if gain > 0.0 { read / gain } else { 0.0 })
    };
    let (gain, read) = noise_of(&line);
    let [vff, vfg, vgg] = line.covariance;
    // read = √(F − 1/12)/g; the black level enters F by the slope.
    let read_noise_sd = if read > 0.0 {
        let (by_f, by_g) = (1.0 / (2.0 * gain * gain * read), -read / gain);
        (by_f * by_f * (vff + (gain * black.1).powi(2)) + 2.0 * by_f * by_g * vfg + by_g * by_g * vgg).max(0.0).sqrt()
    } else {
        0.0
    };
    let noise = Noise {
        black_dn: black.0,
        saturation_dn: saturation.0.max(black.0 + 1.0),
        gain_dn_per_electron: gain,
        read_noise_electrons: read,
    };
    let (gain_sd, black_sd) = (vgg.sqrt(), black.1);
    let blocks = line.blocks;
    let saturation_seen = saturation.1;
    Ok(NoiseEstimate { noise, gain_sd, read_noise_sd, black_sd, saturation_seen, blocks, channel_gains: None })
}

/// Variance over level above black.
#[derive(Debug, Clone, Copy, Default)]
struct Line {
    at_black: f64,
    slope: f64,
    /// Of `at_black`, of both, of `slope`.
    covariance: [f64; 3],
    blocks: usize,
}

impl Line {
    fn at(&self, level: f64) -> f64 {
        (self.at_black + self.slope * level).max(1e-3)
    }

    /// Weighted least squares over the blocks that this line does not make outliers, nor neighbours of one: those hold
    /// the blur of its stripe. `None` without blocks at two levels.
    fn refit(&self, grids: &[BlockGrid], black: f64) -> Option<Self> {
        // A variance of so many degrees of freedom is known to √(2/n); five of that.
        let limit = 1.0 + 5.0 * (2.0 / FREEDOM).sqrt();
        let strange = |b: &Option<Block>| b.is_none_or(|b| b.variance > limit * self.at(b.mean - black));
        let mut s = [0.0f64; 5];
        let mut blocks = 0;
        for grid in grids {
            let [nx, ny] = grid.size;
            let odd: Vec<bool> = grid.blocks.chunks(3).map(|b| b.iter().any(strange)).collect();
            for place in 0..nx * ny {
                let (x, y) = (place % nx, place / nx);
                let around = |v: usize, n: usize| v.saturating_sub(1)..(v + 2).min(n);
                if around(y, ny).any(|y| around(x, nx).any(|x| odd[y * nx + x])) {
                    continue;
                }
                for b in grid.blocks[3 * place..3 * place + 3].iter().flatten() {
                    let level = b.mean - black;
                    let w = FREEDOM / (2.0 * self.at(level).powi(2));
                    s = [
                        s[0] + w,
                        s[1] + w * level,
                        s[2] + w * level * level,
                        s[3] + w * b.variance,
                        s[4] + w * level * b.variance,
                    ];
                    blocks += 1;
                }
            }
        }
        let det = s[0] * s[2] - s[1] * s[1];
        let solved = Self {
            at_black: (s[2] * s[3] - s[1] * s[4]) / det,
            slope: (s[0] * s[4] - s[1] * s[3]) / det,
            covariance: [s[2] / det, -s[1] / det, s[0] / det],
            blocks,
        };
        (blocks >= 2 * LEAST_BLOCKS && det > 0.0).then_some(solved)
    }
}

#[cfg(test)]
mod tests;
