//! What a picture looks like, when it does not show what it should.

use super::photographs::Photographs;
use crate::Result;
use crate::radiance::Radiance;

/// Pictures that agree this well in the logarithm of their light are the same picture.
const SAME: f64 = 0.9;
/// Movements that are tried, px of the working resolution.
const MOVED_PX: isize = 6;
/// What a movement has to agree better than the others: it has two numbers to fit with.
const MOVED_GAIN: f64 = 0.01;

/// What `own`, of the photograph at a `place` of the bracket of shot number `shot` or of all of them, looks like: one
/// of the shots beside it, `expected` turned, mirrored or moved, or in the words `same` the same. `None` for nothing of
/// that.
///
/// Logarithms of light are compared, from the noise of `own` to its brightest.
///
/// # Errors
/// Those of decoding.
pub(super) fn looks(
    photographs: &Photographs<'_>,
    (shot, place): (usize, Option<usize>),
    own: &Radiance,
    expected: &Radiance,
    same: &str,
) -> Result<Option<String>> {
    let Some(levels) = Levels::of(own) else { return Ok(Some("it is black".into())) };
    let seen = Picture::new(own, &levels);
    let rest = Picture::new(expected, &levels);
    let [w, h] = seen.size;
    let mut candidates: Vec<(f64, String)> = Vec::new();
    for near in [shot.checked_sub(1), Some(shot + 1)].into_iter().flatten() {
        if near < photographs.brackets.len() {
            // What is expected has not that exposure either.
            let alone = photographs.brackets[near].len() == 1;
            candidates.push(seen.as_shot(photographs, near, |k| alone || Some(k) != place, &levels)?);
        }
    }
    let as_expected = seen.correlation(|x, y| rest.at(x, y));
    let mut push = |r: f64, words: &str| candidates.push((r, words.to_owned()));
    push(seen.correlation(|x, y| rest.at(w - 1 - x, h - 1 - y)), "it is turned by 180°");
    push(seen.correlation(|x, y| rest.at(w - 1 - x, y)), "it is mirrored left to right");
    push(seen.correlation(|x, y| rest.at(x, h - 1 - y)), "it is mirrored top to bottom");
    let shifts = (-MOVED_PX..=MOVED_PX).flat_map(|dy| (-MOVED_PX..=MOVED_PX).map(move |dx| (dx, dy)));
    let moved = |&(dx, dy): &(isize, isize)| seen.correlation(|x, y| rest.at(x - dx, y - dy));
    let best = shifts.filter(|s| *s != (0, 0)).map(|s| (moved(&s), s)).max_by(|a, b| a.0.total_cmp(&b.0));
    if let Some((r, (dx, dy))) = best {
        candidates.push((r - MOVED_GAIN, format!("it has moved by about {dx}, {dy} px")));
    }
    // What looks like what it should is something else only where that explains half of what is between.
    let better = |r: f64| 1.0 - r < 0.5 * (1.0 - as_expected);
    candidates.retain(|c| better(c.0));
    candidates.push((as_expected, same.to_owned()));
    Ok(likeliest(candidates))
}

/// Which of some shots a picture shows, if any: the one that agrees best in the logarithm of its light.
///
/// # Errors
/// Those of decoding.
pub(super) fn shown_shot(photographs: &Photographs<'_>, own: &Radiance, shots: &[usize]) -> Result<Option<String>> {
    let Some(levels) = Levels::of(own) else { return Ok(None) };
    let seen = Picture::new(own, &levels);
    let candidates = shots.iter().map(|&shot| seen.as_shot(photographs, shot, |_| true, &levels));
    Ok(likeliest(candidates.collect::<Result<_>>()?))
}

/// What agrees best, if anything does.
fn likeliest(candidates: Vec<(f64, String)>) -> Option<String> {
    candidates.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)).filter(|best| best.0 > SAME).map(|best| best.1)
}

/// The range of light that a picture shows.
struct Levels {
    low: f32,
    high: f32,
}

impl Levels {
    /// `None` when it shows none.
    fn of(picture: &Radiance) -> Option<Self> {
        let measured = picture.luminance_variance().into_iter().zip(picture.used.as_chunks::<3>().0);
        let mut sd: Vec<f32> = measured.filter(|(_, u)| !u.contains(&0)).map(|(v, _)| v.sqrt()).collect();
        if sd.is_empty() {
            return None;
        }
        // That of the dark: the least but for chance.
        let tenth = sd.len() / 10;
        let low = 6.0 * *sd.select_nth_unstable_by(tenth, f32::total_cmp).1;
        let high = picture.luminance().into_iter().fold(0.0, f32::max);
        (high > 2.0 * low).then_some(Self { low, high })
    }
}

/// Logarithms of light.
struct Picture {
    size: [isize; 2],
    light: Vec<f32>,
}

impl Picture {
    /// What saturates is the brightest.
    fn new(picture: &Radiance, levels: &Levels) -> Self {
        let used = picture.used.as_chunks::<3>().0;
        let light = picture.luminance().into_iter().zip(used);
        let log = |(v, u): (f32, &[u8; 3])| {
            if u.contains(&0) { levels.high.ln() } else { v.clamp(levels.low, levels.high).ln() }
        };
        Self { size: [picture.rect.width as isize, picture.rect.height as isize], light: light.map(log).collect() }
    }

    /// How well this agrees with what a shot shows, and the words for that.
    fn as_shot(
        &self,
        photographs: &Photographs<'_>,
        shot: usize,
        of: impl Fn(usize) -> bool,
        levels: &Levels,
    ) -> Result<(f64, String)> {
        let picture = Self::new(&photographs.merge_some(shot, of)?, levels);
        let r = self.correlation(|x, y| picture.at(x, y));
        Ok((r, format!("it shows shot \"{}\"", photographs.name(shot))))
    }

    /// Outside, the nearest pixel.
    fn at(&self, x: isize, y: isize) -> f32 {
        let [w, h] = self.size;
        self.light[(y.clamp(0, h - 1) * w + x.clamp(0, w - 1)) as usize]
    }

    fn correlation(&self, other: impl Fn(isize, isize) -> f32) -> f64 {
        let [w, h] = self.size;
        let mut sums = [0.0f64; 5];
        for y in 0..h {
            for x in 0..w {
                let (a, b) = (f64::from(self.at(x, y)), f64::from(other(x, y)));
                [a, b, a * a, b * b, a * b].into_iter().zip(&mut sums).for_each(|(v, s)| *s += v);
            }
        }
        let n = (w * h) as f64;
        let [a, b, aa, bb, ab] = sums.map(|s| s / n);
        let spread = ((aa - a * a) * (bb - b * b)).sqrt();
        if spread > 0.0 { (ab - a * b) / spread } else { 0.0 }
    }
}
