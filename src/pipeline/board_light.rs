//! Whether the board's photograph is turned or mirrored: projector and lens light the white reference unevenly, and the white of the board alike.

use crate::ConsistencyWarning;
use crate::radiance::Radiance;
use serde::{Deserialize, Serialize};

/// Tiles that show this share less light than the mean are no white of the board.
const DARK: f64 = 0.4;
/// With fewer tiles nothing is said.
const LEAST_TILES: usize = 12;
/// Another side up must leave less than this share of what the picture as it is leaves, which must be this much, ln.
const BETTER: f64 = 0.5;
const LEAST_LEFT: f64 = 0.01;

/// The light of the white in the tiles of a picture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Tiles {
    columns: usize,
    rows: usize,
    light: Vec<Option<f64>>,
}

impl Tiles {
    /// Tiles of about `side_px`: of each what a tenth of its pixels exceeds, which on a board of squares is white. `keep`: pixels that count.
    pub(super) fn of(picture: &Radiance, side_px: f64, keep: impl Fn(f64, f64) -> bool) -> Self {
        let count = |size: usize| ((size as f64 / side_px).floor() as usize).max(1);
        Self::cut(picture, [count(picture.rect.width), count(picture.rect.height)], keep)
    }

    /// The same tiles of another picture.
    pub(super) fn alike(&self, picture: &Radiance) -> Self {
        Self::cut(picture, [self.columns, self.rows], |_, _| true)
    }

    fn cut(picture: &Radiance, [columns, rows]: [usize; 2], keep: impl Fn(f64, f64) -> bool) -> Self {
        let [width, height] = [picture.rect.width, picture.rect.height];
        let light = picture.luminance();
        let tile = |k: usize| {
            let edge = |k: usize, n: usize, size: usize| k * size / n;
            let xs = edge(k % columns, columns, width)..edge(k % columns + 1, columns, width);
            let ys = edge(k / columns, rows, height)..edge(k / columns + 1, rows, height);
            // A few hundred pixels are enough.
            let step = (xs.len().max(ys.len()) / 24).max(1);
            let all = ys.step_by(step).flat_map(|y| xs.clone().step_by(step).map(move |x| (x, y)));
            let all: Vec<(usize, usize)> = all.collect();
            let measured = |&&(x, y): &&(usize, usize)| {
                let p = 3 * (y * width + x);
                keep(x as f64, y as f64) && !picture.used[p..p + 3].contains(&0)
            };
            let mut values: Vec<f64> =
                all.iter().filter(measured).map(|&(x, y)| f64::from(light[y * width + x])).collect();
            values.sort_by(f64::total_cmp);
            let enough = 4 * values.len() > 3 * all.len();
            values.get(values.len() * 9 / 10).copied().filter(|v| enough && *v > 0.0)
        };
        Self { columns, rows, light: (0..columns * rows).map(tile).collect() }
    }

    /// What is left, as a standard deviation of ln, of the board's tiles over those of the white reference, each taken from where `place` says.
    fn left(&self, white: &Self, place: impl Fn([usize; 2]) -> [usize; 2]) -> Option<f64> {
        let brightest = self.light.iter().flatten().copied().fold(0.0, f64::max);
        let ratio = |k: usize| {
            let [x, y] = place([k % self.columns, k / self.columns]);
            let (own, other) = (self.light[k]?, white.light[y * self.columns + x]?);
            (own > DARK * brightest).then(|| (own / other).ln())
        };
        let all: Vec<f64> = (0..self.light.len()).filter_map(ratio).collect();
        let n = all.len() as f64;
        let mean = all.iter().sum::<f64>() / n;
        (all.len() >= LEAST_TILES).then(|| (all.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / n).sqrt())
    }

    /// What the board's picture is, where it fits the white reference much better turned or mirrored.
    pub(super) fn turned(&self, white: &Self, shot: &str) -> Option<ConsistencyWarning> {
        let (nx, ny) = (self.columns - 1, self.rows - 1);
        let as_it_is = self.left(white, |at| at)?;
        if std::env::var_os("DBG").is_some() {
            eprintln!(
                "DBG board {}x{} as {as_it_is:.4} t {:?} x {:?} y {:?}",
                self.columns,
                self.rows,
                self.left(white, |[x, y]| [nx - x, ny - y]),
                self.left(white, |[x, y]| [nx - x, y]),
                self.left(white, |[x, y]| [x, ny - y])
            );
        }
        let others = [
            ("turned by 180°", self.left(white, |[x, y]| [nx - x, ny - y])),
            ("mirrored, left to right", self.left(white, |[x, y]| [nx - x, y])),
            ("mirrored, top to bottom", self.left(white, |[x, y]| [x, ny - y])),
        ];
        let better = others.into_iter().filter_map(|(looks, left)| Some((left?, looks)));
        let (left, looks) = better.min_by(|a, b| a.0.total_cmp(&b.0))?;
        (as_it_is > LEAST_LEFT && left < BETTER * as_it_is).then(|| ConsistencyWarning::BoardTurned {
            shot: shot.to_owned(),
            looks: looks.to_owned(),
            left: as_it_is,
            turned_left: left,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;

    /// Light that falls off towards one corner, on squares of 9 px where there is a board.
    fn picture(board: bool, place: impl Fn(usize, usize) -> [usize; 2]) -> Radiance {
        let rect = Rect { x: 0, y: 0, width: 150, height: 110 };
        let light = |k: usize| {
            let [x, y] = place(k % 150, k / 150);
            let dark = board && (x / 9 + y / 9).is_multiple_of(2);
            let fall = 1.0 - 0.0011 * x as f64 - 0.0008 * y as f64;
            (100.0 * fall * if dark { 0.05 } else { 0.9 }) as f32
        };
        let value = (0..rect.area()).flat_map(|k| [light(k); 3]).collect();
        Radiance { rect, value, variance: vec![1.0; 3 * rect.area()], used: vec![1; 3 * rect.area()] }
    }

    #[test]
    fn a_board_is_turned_or_mirrored_where_its_white_says_so() {
        let looks = |place: fn(usize, usize) -> [usize; 2]| {
            let tiles = Tiles::of(&picture(true, place), 24.0, |_, _| true);
            let white = tiles.alike(&picture(false, |x, y| [x, y]));
            tiles.turned(&white, "board").map(|w| w.to_string())
        };
        assert_eq!(looks(|x, y| [x, y]), None);
        assert!(looks(|x, y| [149 - x, 109 - y]).unwrap().contains("turned by 180°"));
        assert!(looks(|x, y| [149 - x, y]).unwrap().contains("left to right"));
        assert!(looks(|x, y| [x, 109 - y]).unwrap().contains("top to bottom"));
    }
}
