//! Light of other patterns in the lattice shots: what is left of the pattern before, what there is already of the next.
//!
//! Dots of the patterns beside, as far from the shot's own dots as there are any, lie where the sample glows little and
//! evenly. Light that rises there from its surroundings as a dot does is a share of that dot's light; over all shots
//! together a hundredth of it is seen. What the sample's own structure does there, the other patterns beside tell.
//!
//! Not detected: light of patterns whose dots all lie beside the shot's own, as in a grid of one row; and of lattices
//! that are no multiple of the dots' distance along both axes, which have no dot at the end of a row by itself. There
//! `reciprocity/lag.rs` sees a tenth.

use super::BuildOptions;
use super::drift::around;
use super::lattice::ShotResult;
use super::scene::{Scene, grown, square};
use crate::capture::Rect;
use crate::cholesky::solve_small;
use crate::geometry::Point;
use crate::radiance::{Bracket, Radiance};
use crate::registration::{Registration, median, scaled_deviation};
use crate::warning::bounds::REFUSED_REMAINS;
use crate::{ConsistencyWarning, Result, Warning};
use serde::{Deserialize, Serialize};

/// Patterns that are looked for, shots later; below 0 earlier. Of the last no light can be: it only tells structure.
const LATER: [isize; 4] = [-2, -1, 1, 2];
/// Dots of each that are looked at: those farthest from the shot's own.
const DOTS: usize = 4;
/// A ring is around a dot's light, so far from its edge that a lens blurs little of it across, px; as wide at the least,
/// and half as wide as the dot's radius.
const APART_PX: f64 = 1.5;
/// Structure of the sample is this share of its light at the least (chessboards of the default bench: 0.03): a few
/// values tell it.
const LEAST_STRUCTURE: f64 = 0.1;
/// Fewer than [`LEAST_VALUES`] tell nothing: a boundary between media of which one sends back twice the other's light,
/// through the middle of a dot's place, makes a third.
const UNKNOWN_STRUCTURE: f64 = 0.3;
const LEAST_VALUES: usize = 3;
/// Told from so many standard deviations on.
const SIGMA: f64 = 6.0;
/// And from this share of a dot's light on: what rows are uncertain by anyway, by the white reference's reflectance.
const LEAST_SHARE: f64 = 0.005;
/// A colour has the light alone when the others have less than this share of it.
const ALONE: f64 = 0.4;

/// How much brighter a dot's place is than its surroundings, of one channel, DN/s.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Spot {
    /// Mean over the dot less that of the surroundings, carried on as a plane.
    rise: f64,
    /// Its variance.
    variance: f64,
    /// That plane at the dot.
    around: f64,
}

/// A place of another pattern's dot.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Elsewhere {
    /// Shots later.
    later: isize,
    /// Number of the dot in its own shot.
    number: usize,
    spots: [Spot; 3],
}

/// What a shot shows at its own dots and at those of the patterns beside.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Spots {
    own: Vec<Option<[Spot; 3]>>,
    elsewhere: Vec<Elsewhere>,
}

/// The dots of other patterns that are looked at in a shot.
pub(super) struct Sought {
    /// Shots later, number of the dot in its shot, place without drift, pixels around it.
    dots: Vec<(isize, usize, Point, Rect)>,
}

impl Sought {
    pub(super) fn of(scene: &Scene<'_>, shot: usize) -> Self {
        let lattice = scene.lattice();
        let own: Vec<Point> = scene.dots(shot).iter().map(|&d| scene.nominal_mm(d)).collect();
        let far = |p: Point| own.iter().map(|q| (p[0] - q[0]).hypot(p[1] - q[1])).fold(f64::INFINITY, f64::min);
        // The ring is clear of the shot's own dots.
        let least_mm = (reach_px(scene) + APART_PX + scene.dot_radius_px()) / scene.px_per_mm;
        let size_px = scene.capture.rig.camera.size_px;
        let mut dots = Vec::new();
        for later in LATER {
            let other = lattice.iter().position(|&s| s == shot).and_then(|k| k.checked_add_signed(later));
            let Some(&other) = other.and_then(|k| lattice.get(k)) else { continue };
            let mut all: Vec<(usize, Point, f64)> = scene
                .dots(other)
                .iter()
                .map(|&d| scene.nominal_mm(d))
                .enumerate()
                .map(|(k, p)| (k, p, far(p)))
                .collect();
            all.retain(|dot| dot.2 > least_mm);
            all.sort_by(|a, b| b.2.total_cmp(&a.2));
            for (number, at, _) in all.into_iter().take(DOTS) {
                let near = square(scene.registration.view.camera_from_slab(at), reach_px(scene) + 1.0, size_px);
                dots.extend(near.map(|r| (later, number, at, grown(r, scene.drift_search_px() as usize, size_px))));
            }
        }
        Self { dots }
    }

    pub(super) fn rects(&self) -> impl Iterator<Item = Rect> {
        self.dots.iter().map(|d| d.3)
    }

    /// Looks at a shot whose pattern has moved by `moved` on the slab: at its own dots in their windows, and at those
    /// of other patterns.
    pub(super) fn look(
        &self,
        scene: &Scene<'_>,
        registration: &Registration,
        moved: Point,
        (centers, windows): (&[Point], &[Bracket]),
        elsewhere: &[Bracket],
    ) -> Spots {
        let see = |at: Point, bracket: &Bracket| {
            let picture = around(scene, registration, bracket, at, reach_px(scene) + 1.0)?;
            spots(&picture, registration.view.camera_from_slab(at), scene.dot_radius_px())
        };
        let own = centers.iter().zip(windows).map(|(&at, bracket)| see(at, bracket)).collect();
        let other = |(&(later, number, at, _), bracket): (&(isize, usize, Point, Rect), &Bracket)| {
            let spots = see([at[0] + moved[0], at[1] + moved[1]], bracket)?;
            Some(Elsewhere { later, number, spots })
        };
        Spots { own, elsewhere: self.dots.iter().zip(elsewhere).filter_map(other).collect() }
    }
}

/// The ring's radii, px.
fn ring_px(radius_px: f64) -> [f64; 2] {
    let inner = radius_px + APART_PX;
    [inner, inner + APART_PX.max(0.5 * radius_px)]
}

fn reach_px(scene: &Scene<'_>) -> f64 {
    ring_px(scene.dot_radius_px())[1]
}

/// The light of a place over what is around it; `None` where not all of it was measured.
fn spots(picture: &Radiance, at: Point, radius_px: f64) -> Option<[Spot; 3]> {
    let [inner, outer] = ring_px(radius_px);
    let rect = picture.rect;
    let ends = [(0, rect.x, rect.width), (1, rect.y, rect.height)];
    if ends.iter().any(|&(a, from, n)| at[a] - outer < from as f64 || at[a] + outer > (from + n - 1) as f64) {
        return None;
    }
    let (mut dot, mut ring) = (Vec::new(), Vec::new());
    for k in 0..rect.area() {
        let d = [(rect.x + k % rect.width) as f64 - at[0], (rect.y + k / rect.width) as f64 - at[1]];
        match d[0].hypot(d[1]) {
            r if r <= radius_px => dot.push((k, d)),
            r if r >= inner && r <= outer => ring.push((k, d)),
            _ => continue,
        }
        (0..3).all(|c| picture.used[3 * k + c] > 0).then_some(())?;
    }
    let spot =
        |c: usize| spot(&|k| [picture.value[3 * k + c], picture.variance[3 * k + c]].map(f64::from), &dot, &ring);
    Some([spot(0)?, spot(1)?, spot(2)?])
}

/// Pixels by their number, from the middle of a dot.
type Pixels = [(usize, Point)];

fn spot(light: &dyn Fn(usize) -> [f64; 2], dot: &Pixels, ring: &Pixels) -> Option<Spot> {
    let (mut a, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
    for &(k, d) in ring {
        let row = [1.0, d[0], d[1]];
        for i in 0..3 {
            (0..3).for_each(|j| a[i][j] += row[i] * row[j]);
            b[i] += row[i] * light(k)[0];
        }
    }
    let (plane, _) = solve_small(a, b)?;
    let n = dot.len() as f64;
    let over = |&(k, d): &(usize, Point)| light(k)[0] - plane[0] - plane[1] * d[0] - plane[2] * d[1];
    let noise = |pixels: &Pixels| pixels.iter().map(|&(k, _)| light(k)[1]).sum::<f64>() / (pixels.len() as f64).powi(2);
    (n > 0.0).then(|| Spot {
        rise: dot.iter().map(over).sum::<f64>() / n,
        variance: noise(dot) + noise(ring),
        around: plane[0],
    })
}

/// A place of another pattern's dot, over that dot's own light.
#[derive(Debug, Clone, Copy)]
struct Value {
    share: f64,
    variance: f64,
    around: f64,
}

/// The share of a pattern's light that all shots have, and its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Share {
    share: f64,
    sd: f64,
    /// How many places tell it.
    places: usize,
}

impl Share {
    fn is_told(&self) -> bool {
        self.share > LEAST_SHARE.max(SIGMA * self.sd)
    }
}

/// What shots have of the light of patterns so many shots later, in some channels together.
fn values(results: &[ShotResult], later: isize, channels: &[usize]) -> Vec<Value> {
    let mut found = Vec::new();
    for (k, result) in results.iter().enumerate() {
        for place in result.spots.elsewhere.iter().filter(|e| e.later == later) {
            let other = k.checked_add_signed(later).and_then(|k| results.get(k));
            let Some(Some(own)) = other.map(|r| r.spots.own.get(place.number).copied().flatten()) else { continue };
            let sum = |of: &dyn Fn(usize) -> f64| channels.iter().map(|&c| of(c)).sum::<f64>();
            let light = sum(&|c| own[c].rise);
            if light > SIGMA * sum(&|c| own[c].variance).sqrt() {
                found.push(Value {
                    share: sum(&|c| place.spots[c].rise) / light,
                    variance: sum(&|c| place.spots[c].variance) / (light * light),
                    around: sum(&|c| place.spots[c].around) / light,
                });
            }
        }
    }
    found
}

/// What the sample's own light does, over that light: its mean rise, and what places differ by. Most of `none` have no
/// other light.
fn structure(none: &[Value]) -> [f64; 2] {
    let mut over: Vec<f64> = none.iter().filter(|v| v.around > 0.0).map(|v| v.share / v.around).collect();
    if over.len() < LEAST_VALUES {
        return [0.0, UNKNOWN_STRUCTURE];
    }
    let middle = median(&mut over);
    let noise = median(&mut none.iter().map(|v| v.variance.sqrt() / v.around.abs().max(1e-12)).collect::<Vec<_>>());
    let spread = scaled_deviation(over.iter().copied(), middle);
    [middle, (spread * spread - noise * noise).max(0.0).sqrt().max(LEAST_STRUCTURE)]
}

/// The share that most values agree about: their weighted median.
fn share(values: &[Value], [rise, structure]: [f64; 2]) -> Option<Share> {
    let mut all: Vec<(f64, f64)> = values
        .iter()
        .map(|v| (v.share - rise * v.around, 1.0 / (v.variance + (structure * v.around).powi(2)).max(1e-18)))
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = all.iter().map(|v| v.1).sum();
    let mut sum = 0.0;
    let share = all
        .iter()
        .find(|v| {
            sum += v.1;
            sum >= 0.5 * total
        })?
        .0;
    // By more than they are known to they differ where light is not the same everywhere.
    let off = scaled_deviation(all.iter().map(|v| (v.0 - share) * v.1.sqrt()), 0.0);
    Some(Share { share, sd: 1.25 * off.max(1.0) / total.sqrt(), places: values.len() })
}

/// What is to be told.
///
/// # Errors
/// [`crate::Error::Contradiction`].
pub(super) fn judge(results: &[ShotResult], options: &BuildOptions) -> Result<Option<Warning>> {
    let Some(finding) = find(results) else { return Ok(None) };
    match finding {
        ConsistencyWarning::PatternRemains { share, .. } if share >= REFUSED_REMAINS => {
            options.refuse(finding).map(Some)
        }
        _ => Ok(Some(finding.into())),
    }
}

/// Whether places far from the shots' own dots show that less than `share` of a dot's light is left of the pattern
/// before; `false` where too few are seen.
pub(super) fn exclude(results: &[ShotResult], share: f64) -> bool {
    let before = LATER.iter().position(|later| *later == -1);
    let found = before.and_then(|k| shares(results, &[0, 1, 2])[k]);
    found.is_some_and(|s| s.places >= LEAST_VALUES && s.share + SIGMA * s.sd < share)
}

/// The shares of the patterns of [`LATER`], but for the last, in some channels together.
fn shares(results: &[ShotResult], channels: &[usize]) -> [Option<Share>; 3] {
    let all = LATER.map(|later| values(results, later, channels));
    [0, 1, 2].map(|k| {
        let others = (0..LATER.len()).filter(|o| *o != k).flat_map(|o| all[o].iter().copied());
        share(&all[k], structure(&others.collect::<Vec<_>>()))
    })
}

fn find(results: &[ShotResult]) -> Option<ConsistencyWarning> {
    let (together, each) = (shares(results, &[0, 1, 2]), [0, 1, 2].map(|c| shares(results, &[c])));
    let told = |shares: &[Option<Share>; 3]| {
        let told = (0..3).filter_map(|k| Some((k, shares[k].filter(Share::is_told)?)));
        told.max_by(|a, b| a.1.share.total_cmp(&b.1.share))
    };
    let brightest = (0..3).filter_map(|c| Some((c, told(&each[c])?)));
    let brightest = brightest.max_by(|a, b| a.1.1.share.total_cmp(&b.1.1.share));
    let alone = brightest.filter(|&(c, (k, found))| {
        let is_small = |o: usize| each[o][k].is_none_or(|s| s.share < ALONE * found.share);
        (0..3).filter(|o| *o != c).all(is_small)
    });
    let (k, Share { share, sd, .. }) = alone.map(|a| a.1).or_else(|| told(&together))?;
    Some(ConsistencyWarning::PatternRemains { later: LATER[k], share, sd, channel: alone.map(|a| a.0) })
}

#[cfg(test)]
mod tests;
