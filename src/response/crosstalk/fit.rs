//! Fitting the kernel and the two maps by multiplicative steps.

use super::exponentials::mixture;
use super::kernel::{Kernel, Place, interpolate};
use super::{ChannelModel, LitRow, OutgoingMap, TailModel, distance, reach_mm, sample_mm};
use crate::capture::Window;
use crate::geometry::Point;
use rayon::prelude::*;

/// Distances from one node of the kernel to the next, in outgoing samples.
const NODE_SAMPLES: f64 = 0.5;
/// Rounds of updates at the most; each settles kernel, incident and outgoing factors in turn.
const ROUNDS: usize = 30;
/// Rounds end when no factor changes by more than this: a thirtieth of what the model is trusted to.
const SETTLED: f64 = 1e-3;
/// Relative error of the model that the weights assume while it is fitted.
pub(super) const ASSUMED_SD: f64 = 0.2;
/// The model is never trusted to better than this.
const LEAST_SD: f64 = 0.03;
/// What the model misses is larger than what it leaves of the samples that it was fitted to (on simulated slabs up to 2
/// times).
const OPTIMISM: f64 = 1.7;
/// A sample is its own dot's when this share of its light is modelled to be.
const OWN_SHARE: f64 = 0.8;
/// Pairs of sample and dot that are used at most; beyond, samples are left out evenly.
const MOST_PAIRS: usize = 1_500_000;
/// Samples this near to their own dot are never left out: there are few of them.
const CORE_SAMPLES: f64 = 3.0;
/// Steps are no larger than this factor.
const LARGEST_STEP: f64 = 2.0;

/// A sample of a row and the dots that light it.
pub(super) struct Sample {
    pub(super) shot: usize,
    pub(super) dot: usize,
    pub(super) index: usize,
    pub(super) cell: usize,
    /// Its own dot's place among the pairs.
    pub(super) own: usize,
    pub(super) pairs: std::ops::Range<usize>,
}

pub(super) struct Pair {
    /// Number of the dot among all.
    pub(super) dot: usize,
    pub(super) place: Place,
}

pub(super) struct Layout {
    pub(super) samples: Vec<Sample>,
    pub(super) pairs: Vec<Pair>,
    pub(super) flux: Vec<[f64; 3]>,
    pub(super) step_mm: f64,
    pub(super) nodes: usize,
}

/// Fits the model to the rows of some shots, which must be whole: every dot that was lit is in its shot.
///
/// `window` is that of the rows, `size_mm` the slab's. Minimizes no likelihood exactly: each factor is scaled by the
/// mean of measured over modelled light, weighted by how much of the light is its own and how well it was measured (the
/// multiplicative steps of Richardson1972 and Lucy1974), which keeps all of them positive. `None` when the rows hold no
/// light.
///
/// Not detected: kernels that are not round (a slanted grain): their excess is in the model's stated error.
pub fn fit_tails(shots: &[Vec<LitRow>], window: &Window, size_mm: Point) -> Option<TailModel> {
    let layout = lay_out(shots, window, size_mm);
    let fit = |c: usize| fit_channel(shots, &layout, window, size_mm, c);
    let mut channels: Vec<ChannelModel> = (0..3).into_par_iter().map(fit).collect::<Option<_>>()?;
    let (c2, c1, c0) = (channels.pop()?, channels.pop()?, channels.pop()?);
    Some(TailModel { channels: [c0, c1, c2] })
}

fn lay_out(shots: &[Vec<LitRow>], window: &Window, size_mm: Point) -> Layout {
    let (reach, step_mm) = (reach_mm(window), NODE_SAMPLES * window.pitch_mm);
    let nodes = (reach / step_mm).ceil() as usize + 2;
    let map = OutgoingMap::even(size_mm, window.pitch_mm);
    let neighbours = |shot: &[LitRow]| shot.len().min(neighbours_within(shot, reach));
    let all: usize = shots.iter().map(|s| s.len() * neighbours(s) * window.samples[0] * window.samples[1]).sum();
    let every = all.div_ceil(MOST_PAIRS).max(1);
    let mut layout = Layout { samples: vec![], pairs: vec![], flux: vec![], step_mm, nodes };
    for (s, shot) in shots.iter().enumerate() {
        let first = layout.flux.len();
        layout.flux.extend(shot.iter().map(|r| r.flux));
        for (d, row) in shot.iter().enumerate() {
            for index in 0..window.samples[0] * window.samples[1] {
                let at = sample_mm(window, row.center_mm, index % window.samples[0], index / window.samples[0]);
                let core = distance(at, row.center_mm) < CORE_SAMPLES * window.pitch_mm;
                // A stride that is prime to any window's side spreads what is kept over rows and samples alike.
                if !core && (index * 7919 + d * 104_729 + s * 31) % every != 0 {
                    continue;
                }
                let start = layout.pairs.len();
                let mut own = start;
                for (j, other) in shot.iter().enumerate() {
                    let r = distance(at, other.center_mm);
                    if j == d {
                        own = layout.pairs.len();
                    } else if r > reach {
                        continue;
                    }
                    layout.pairs.push(Pair { dot: first + j, place: Kernel::place(step_mm, nodes, r) });
                }
                let pairs = start..layout.pairs.len();
                layout.samples.push(Sample { shot: s, dot: d, index, cell: map.index(at), own, pairs });
            }
        }
    }
    layout
}

/// An estimate of how many dots of a shot light one sample.
fn neighbours_within(shot: &[LitRow], reach_mm: f64) -> usize {
    let middle = &shot[shot.len() / 2];
    shot.iter().filter(|r| distance(r.center_mm, middle.center_mm) <= reach_mm).count()
}

/// What one channel measured at the samples, and the state of its fit.
pub(super) struct Fit<'a> {
    pub(super) layout: &'a Layout,
    pub(super) channel: usize,
    /// Light and its variance; `None` where nothing was measured.
    pub(super) seen: Vec<Option<(f64, f64)>>,
    pub(super) kernel: Vec<f64>,
    pub(super) incident: Vec<f64>,
    pub(super) outgoing: Vec<f64>,
}

fn fit_channel(
    shots: &[Vec<LitRow>],
    layout: &Layout,
    window: &Window,
    size_mm: Point,
    channel: usize,
) -> Option<ChannelModel> {
    let mut outgoing = OutgoingMap::even(size_mm, window.pitch_mm);
    let mut fit = Fit::new(shots, layout, outgoing.value.clone(), channel);
    fit.kernel = mixture(&fit, NODE_SAMPLES)?;
    for _ in 0..ROUNDS {
        let changes = [fit.update_kernel(), fit.update_incident(), fit.update_outgoing()];
        if changes.into_iter().all(|change| change < SETTLED) {
            break;
        }
    }
    let relative_sd = fit.relative_sd();
    outgoing.value = fit.outgoing;
    Some(ChannelModel { kernel: Kernel::new(layout.step_mm, fit.kernel), relative_sd, outgoing })
}

/// A sum of weighted ratios that starts from "no change" with some weight.
#[derive(Clone)]
struct Step {
    top: f64,
    bottom: f64,
}

impl Step {
    /// Starts with the weight of so many samples.
    fn anchored(samples: f64) -> Self {
        let w = samples / (ASSUMED_SD * ASSUMED_SD);
        Self { top: w, bottom: w }
    }

    fn add(&mut self, weight: f64, ratio: f64) {
        self.top += weight * ratio;
        self.bottom += weight;
    }

    fn factor(&self) -> f64 {
        (self.top / self.bottom).clamp(1.0 / LARGEST_STEP, LARGEST_STEP)
    }
}

fn apply(values: &mut [f64], steps: &[Step]) -> f64 {
    values.iter_mut().zip(steps).fold(0.0, |most: f64, (value, step)| {
        let factor = step.factor();
        *value *= factor;
        most.max((factor - 1.0).abs())
    })
}

impl<'a> Fit<'a> {
    /// An even slab, its kernel still to be found.
    fn new(shots: &[Vec<LitRow>], layout: &'a Layout, outgoing: Vec<f64>, channel: usize) -> Self {
        let seen = layout.samples.iter().map(|s| {
            let LitRow { flux, row, .. } = &shots[s.shot][s.dot];
            let (k, flux) = (3 * s.index + channel, flux[channel]);
            row.valid[k].then(|| (f64::from(row.response[k]) * flux, f64::from(row.variance[k]) * flux * flux))
        });
        let (seen, incident) = (seen.collect(), vec![1.0; layout.flux.len()]);
        Self { layout, channel, seen, kernel: vec![], incident, outgoing }
    }

    /// Each pair's light at a sample, into `parts`; their sum.
    fn model(&self, sample: &Sample, parts: &mut Vec<f64>) -> f64 {
        parts.clear();
        let outgoing = self.outgoing[sample.cell];
        parts.extend(self.layout.pairs[sample.pairs.clone()].iter().map(|p| {
            let flux = self.layout.flux[p.dot][self.channel];
            flux * self.incident[p.dot] * outgoing * interpolate(&self.kernel, p.place)
        }));
        parts.iter().sum()
    }

    /// Calls `add(sample, its pairs, share of each, weight, measured over modelled)` for every measured sample.
    fn each(&self, mut add: impl FnMut(&Sample, &[Pair], &[f64], f64, f64)) {
        let mut parts = Vec::new();
        for (sample, seen) in self.layout.samples.iter().zip(&self.seen) {
            let Some((light, variance)) = seen else { continue };
            let total = self.model(sample, &mut parts);
            if !(total > 0.0) {
                continue;
            }
            parts.iter_mut().for_each(|p| *p /= total);
            let weight = 1.0 / (ASSUMED_SD * ASSUMED_SD + variance / (total * total));
            add(sample, &self.layout.pairs[sample.pairs.clone()], &parts, weight, light / total);
        }
    }

    /// This and its siblings return by how much the factor that changed most did.
    fn update_kernel(&mut self) -> f64 {
        let mut steps = vec![Step::anchored(0.5); self.layout.nodes];
        self.each(|_, pairs, shares, weight, ratio| {
            for (pair, share) in pairs.iter().zip(shares) {
                let (n, t) = (pair.place.node as usize, f64::from(pair.place.share));
                steps[n].add((1.0 - t) * share * weight, ratio);
                steps[n + 1].add(t * share * weight, ratio);
            }
        });
        apply(&mut self.kernel, &steps)
    }

    fn update_incident(&mut self) -> f64 {
        let mut steps = vec![Step::anchored(1.0); self.incident.len()];
        self.each(|_, pairs, shares, weight, ratio| {
            pairs.iter().zip(shares).for_each(|(pair, share)| steps[pair.dot].add(share * weight, ratio));
        });
        apply(&mut self.incident, &steps)
    }

    fn update_outgoing(&mut self) -> f64 {
        let mut steps = vec![Step::anchored(2.0); self.outgoing.len()];
        self.each(|sample, _, _, weight, ratio| steps[sample.cell].add(weight, ratio));
        apply(&mut self.outgoing, &steps)
    }

    /// What the model misses at each node, where a dot has its samples to itself. Beyond, nothing tells it: the larger
    /// of the last such and of what is missed where dots share, growing with distance (on simulated chessboards and
    /// veined marble this states 0.8 to 3 times the truth).
    fn relative_sd(&self) -> Vec<f64> {
        let n = self.layout.nodes;
        let (mut sum, mut weight, mut all) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        let mut shared = (0.0, 0.0);
        let noise_free = 1.0 / (ASSUMED_SD * ASSUMED_SD);
        self.each(|sample, _, shares, w, ratio| {
            // The weight holds the noise: 1/w less the assumed error is the variance over the square of the light.
            let missed = (ratio - 1.0).powi(2) - (1.0 / w - ASSUMED_SD * ASSUMED_SD);
            let w = w / noise_free;
            let own = sample.own - sample.pairs.start;
            let node = self.layout.pairs[sample.own].place.node as usize;
            all[node] += w;
            if shares[own] > OWN_SHARE {
                sum[node] += w * missed;
                weight[node] += w;
            } else {
                // The errors of several dots average: that of one is larger by their effective number.
                let effective = 1.0 / shares.iter().map(|s| s * s).sum::<f64>();
                shared.0 += w * missed * effective;
                shared.1 += w;
            }
        });
        let floor = LEAST_SD * LEAST_SD;
        let shared = if shared.1 > 0.0 { (shared.0 / shared.1).max(floor) } else { floor };
        let (mut last, mut last_node) = (floor, 1.0f64);
        (0..n)
            .map(|k| {
                let node = k as f64;
                // Where only the rim of the lattice has its samples to itself, it stands for nothing.
                if weight[k] > 0.5 * all[k] && all[k] > 0.0 {
                    // A few samples tell little: they are joined with what the node before says.
                    last = ((sum[k] + 2.0 * last) / (weight[k] + 2.0)).max(floor);
                    last_node = node.max(1.0);
                    return (OPTIMISM * last.sqrt()).min(1.0);
                }
                (OPTIMISM * last.max(shared).sqrt() * (node / last_node).max(1.0)).min(1.0)
            })
            .collect()
    }
}

#[cfg(test)]
mod tests;
