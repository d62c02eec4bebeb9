//! Sharing the light of a shot among its dots.

use super::{ChannelModel, LitRow, TailModel, distance, sample_mm};
use crate::capture::Window;
use crate::geometry::Point;

/// Rounds in which the dots of one shot settle how much light goes in at each.
const ROUNDS: usize = 6;
/// Light of a dot is followed to where the kernel has fallen to this share of what it is half a window away.
const FAINT: f64 = 1e-3;
/// A sample is modelled, not measured, when less than this share of what the model misses there is put to its own dot.
const MODELLED_BELOW: f64 = 0.5;

/// What [`TailModel::separate`] did to the rows of a shot, all channels together.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Separation {
    /// Sum of responses before.
    pub light: f64,
    /// Of these, what was put to other dots.
    pub removed: f64,
    /// Valid samples.
    pub samples: usize,
    /// Of these, what is modelled rather than measured.
    pub modelled: usize,
    /// Variance that the model's errors leave, by number of a row: sum over rows, and how many had it measured.
    pub(super) variance: Vec<(f64, u32)>,
}

impl Separation {
    /// Adds another shot's.
    pub fn add(&mut self, other: &Self) {
        self.light += other.light;
        self.removed += other.removed;
        self.samples += other.samples;
        self.modelled += other.modelled;
        self.variance.resize(self.variance.len().max(other.variance.len()), (0.0, 0));
        for ((sum, rows), (more, of)) in self.variance.iter_mut().zip(&other.variance) {
            (*sum, *rows) = (*sum + more, *rows + of);
        }
    }

    /// Variance that the model's errors leave in each number of a row, mean over rows. The model errs alike where
    /// neighbours lie alike: a sum over samples or rows keeps this error.
    pub fn mean_variance(&self) -> Vec<f64> {
        self.variance.iter().map(|(sum, rows)| sum / f64::from((*rows).max(1))).collect()
    }
}

impl TailModel {
    /// Leaves in each row of a shot the light of its own dot; `shot` must hold all dots that were lit.
    ///
    /// With own model p, own and others' model variances v and u: R = p + v/(v+u) · (measured − model of all), the best
    /// linear estimate given the model's errors; what noise adds is not traded against the model, so that samples that
    /// no other dot reaches stay as measured. Its variance is the measurement's times (v/(v+u))² plus v·u/(v+u).
    pub fn separate(&self, shot: &mut [LitRow], window: &Window) -> Separation {
        let variance = vec![(0.0, 0); 3 * window.samples[0] * window.samples[1]];
        let mut found = Separation { variance, ..Separation::default() };
        for (c, model) in self.channels.iter().enumerate() {
            let shared: Vec<Vec<Share>> =
                (0..shot.len()).map(|d| model.shares(shot, d, c, window, self.reach_mm(c, window))).collect();
            let incident = model.incident(shot, &shared, c);
            for (d, shares) in shared.iter().enumerate() {
                model.separate_row(&mut shot[d], shares, d, &incident, c, &mut found);
            }
        }
        found
    }

    pub(super) fn reach_mm(&self, channel: usize, window: &Window) -> f64 {
        let kernel = &self.channels[channel].kernel;
        let half = 0.5 * window.pitch_mm * window.samples[0].max(window.samples[1]) as f64;
        let faint = FAINT * kernel.at_distance(half);
        let mut reach = half;
        while reach < super::reach_mm(window) && kernel.at_distance(reach) > faint {
            reach += window.pitch_mm;
        }
        reach
    }

    /// The smallest distance between dots of a square lattice, in samples, at which separated rows are uncertain by no
    /// more than `share` of themselves (Euclidean norm) because of the others; `None` when two windows are not enough.
    ///
    /// Of an even slab: the two maps are left out.
    pub fn spacing_for(&self, share: f64, window: &Window) -> Option<usize> {
        let most = 2 * window.samples[0].max(window.samples[1]);
        (2..=most).find(|&spacing| self.left_at(spacing as f64, window).rms_share <= share)
    }

    /// What the other dots of a square lattice of this distance, in samples, leave separated rows uncertain by. Of an
    /// even slab.
    pub fn left_at(&self, spacing_samples: f64, window: &Window) -> LeftByOthers {
        let side = spacing_samples * window.pitch_mm;
        let (mut error, mut square, mut all, mut light) = (0.0, 0.0, 0.0, 0.0);
        for model in &self.channels {
            let around = (super::reach_mm(window) / side).ceil().min(6.0) as i64;
            for j in 0..window.samples[1] {
                for i in 0..window.samples[0] {
                    let at = sample_mm(window, [0.0; 2], i, j);
                    let part = |center: Point| {
                        let (value, sd) = model.at(distance(at, center));
                        (value, (value * sd).powi(2))
                    };
                    let (value, own) = part([0.0; 2]);
                    let lattice = (-around..=around).flat_map(|y| (-around..=around).map(move |x| [x, y]));
                    let others: f64 =
                        lattice.filter(|k| *k != [0, 0]).map(|k| part(k.map(|k| k as f64 * side)).1).sum();
                    let left: f64 = if own + others > 0.0 { own * others / (own + others) } else { 0.0 };
                    (error, all) = (error + left, all + left.sqrt());
                    (square, light) = (square + value * value, light + value);
                }
            }
        }
        LeftByOthers { rms_share: (error / square).sqrt(), light_share: all / light }
    }
}

/// How uncertain other dots leave a row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LeftByOthers {
    /// Euclidean norm of its samples' standard deviations, of that of the row.
    pub rms_share: f64,
    /// Their sum, of the row's light: what its albedo is uncertain by where the model errs in all samples alike, as it
    /// does in a medium that falls off otherwise than it says.
    pub light_share: f64,
}

/// What one dot of a shot brings to a sample: its light per unit of its incident factor, over the flux of the row's own
/// dot, and the model's relative variance there.
struct Share {
    sample: u32,
    dot: u32,
    light: f64,
    relative_variance: f64,
}

impl ChannelModel {
    /// The kernel and the model's relative standard deviation.
    fn at(&self, distance_mm: f64) -> (f64, f64) {
        let place = self.kernel.place_of(distance_mm);
        (self.kernel.at(place), super::kernel::interpolate(&self.relative_sd, place))
    }

    /// All that lights the window of dot `d`, sample by sample, in units of its own flux.
    fn shares(&self, shot: &[LitRow], d: usize, c: usize, window: &Window, reach_mm: f64) -> Vec<Share> {
        let own = &shot[d];
        let half = 0.5 * window.pitch_mm * (window.samples[0] as f64).hypot(window.samples[1] as f64);
        let near: Vec<usize> =
            (0..shot.len()).filter(|&j| distance(own.center_mm, shot[j].center_mm) <= reach_mm + half).collect();
        let mut out = Vec::with_capacity(near.len() * window.samples[0] * window.samples[1]);
        for k in 0..window.samples[0] * window.samples[1] {
            let at = sample_mm(window, own.center_mm, k % window.samples[0], k / window.samples[0]);
            let outgoing = self.outgoing.value[self.outgoing.index(at)];
            for &j in &near {
                let r = distance(at, shot[j].center_mm);
                if j != d && r > reach_mm {
                    continue;
                }
                let (kernel, sd) = self.at(r);
                let light = outgoing * kernel * shot[j].flux[c] / own.flux[c];
                out.push(Share { sample: k as u32, dot: j as u32, light, relative_variance: sd * sd });
            }
        }
        out
    }

    /// How much light goes in at each dot of a shot, relative to the slab's mean.
    fn incident(&self, shot: &[LitRow], shared: &[Vec<Share>], c: usize) -> Vec<f64> {
        let mut incident = vec![1.0; shot.len()];
        for _ in 0..ROUNDS {
            let mut sums = vec![(1.0, 1.0); shot.len()];
            for (d, shares) in shared.iter().enumerate() {
                let row = &shot[d].row;
                for sample in shares.chunk_by(|a, b| a.sample == b.sample) {
                    let k = 3 * sample[0].sample as usize + c;
                    if !row.valid[k] {
                        continue;
                    }
                    let part = |s: &Share| s.light * incident[s.dot as usize];
                    let total: f64 = sample.iter().map(part).sum();
                    if !(total > 0.0) {
                        continue;
                    }
                    let uncertain = sample.iter().map(|s| s.relative_variance * part(s).powi(2)).sum::<f64>();
                    let weight = total * total / (uncertain + f64::from(row.variance[k])).max(f64::MIN_POSITIVE);
                    let ratio = f64::from(row.response[k]) / total;
                    for s in sample {
                        let w = weight * part(s) / total;
                        let (top, bottom) = &mut sums[s.dot as usize];
                        (*top, *bottom) = (*top + w * ratio, *bottom + w);
                    }
                }
            }
            incident.iter_mut().zip(&sums).for_each(|(a, (top, bottom))| *a *= (top / bottom).clamp(0.5, 2.0));
        }
        incident
    }

    fn separate_row(
        &self,
        lit: &mut LitRow,
        shares: &[Share],
        d: usize,
        incident: &[f64],
        c: usize,
        found: &mut Separation,
    ) {
        for sample in shares.chunk_by(|a, b| a.sample == b.sample) {
            let k = 3 * sample[0].sample as usize + c;
            if !lit.row.valid[k] {
                continue;
            }
            let (mut own, mut own_variance, mut others, mut others_variance) = (0.0, 0.0, 0.0, 0.0);
            for s in sample {
                let light = s.light * incident[s.dot as usize];
                let variance = s.relative_variance * light * light;
                if s.dot as usize == d {
                    (own, own_variance) = (light, variance);
                } else {
                    (others, others_variance) = (others + light, others_variance + variance);
                }
            }
            let measured = f64::from(lit.row.response[k]);
            let both = own_variance + others_variance;
            let gain = if others_variance > 0.0 { own_variance / both } else { 1.0 };
            let response = own + gain * (measured - own - others);
            let modelled = if others_variance > 0.0 { own_variance * others_variance / both } else { 0.0 };
            lit.row.response[k] = response as f32;
            lit.row.variance[k] = (f64::from(lit.row.variance[k]) * gain * gain + modelled) as f32;
            found.variance[k] = (found.variance[k].0 + modelled, found.variance[k].1 + 1);
            found.light += measured;
            found.removed += measured - response;
            found.samples += 1;
            found.modelled += usize::from(gain < MODELLED_BELOW);
        }
    }
}
