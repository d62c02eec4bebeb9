//! Labels beside their dots, none on another.

/// Where a label may be: around its dot, further out the more crowded it is, px.
const DISTANCES: [f64; 6] = [9.0, 18.0, 30.0, 46.0, 66.0, 90.0];
/// Directions that are tried at each distance.
const DIRECTIONS: usize = 12;
/// Widths of a letter and of a line at 11 px, px; a letter is that of a wide sans serif on average.
const LETTER: f64 = 6.3;
const LINE: f64 = 13.0;

/// A rectangle: from, to.
type Area = [[f64; 2]; 2];

/// A text, the dot it is of, and where it stands.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PlacedLabel {
    pub(super) dot: [f64; 2],
    pub(super) text: String,
    pub(super) area: Area,
}

/// Finds places inside `within` that overlap no other label and, as far as that goes, none of `dots`, which may be
/// those of a line.
pub(super) fn place(labels: Vec<([f64; 2], String)>, dots: &[[f64; 2]], within: Area) -> Vec<PlacedLabel> {
    let mut placed: Vec<PlacedLabel> = Vec::new();
    for (dot, text) in labels {
        let size = [text.chars().count() as f64 * LETTER, LINE];
        let cost = |area: &Area, distance: f64| {
            let hidden = dots.iter().filter(|d| inside(d, area, 3.0)).count();
            // A label further out is still better than one that hides a dot.
            distance + 100.0 * hidden as f64
        };
        let free = |area: &Area| {
            let in_it = (0..2).all(|a| area[0][a] >= within[0][a] && area[1][a] <= within[1][a]);
            in_it && placed.iter().all(|p| !overlap(&p.area, area))
        };
        let tried = DISTANCES.into_iter().flat_map(|distance| (0..DIRECTIONS).map(move |k| (distance, k)));
        let found = tried.map(|(distance, k)| (area(dot, size, distance, k), distance)).filter(|(area, _)| free(area));
        let best = found.min_by(|a, b| cost(&a.0, a.1).total_cmp(&cost(&b.0, b.1)));
        // A chart too small for its labels: better one less than two on each other.
        placed.extend(best.map(|(area, _)| PlacedLabel { dot, text, area }));
    }
    placed
}

/// The area of a label whose nearest side lies `distance` from the dot in direction `k`.
fn area(dot: [f64; 2], size: [f64; 2], distance: f64, k: usize) -> Area {
    let angle = std::f64::consts::TAU * k as f64 / DIRECTIONS as f64;
    let towards = [angle.cos(), -angle.sin()];
    let middle: [f64; 2] = std::array::from_fn(|a| dot[a] + towards[a] * (distance + size[a] / 2.0));
    [-0.5, 0.5].map(|end| std::array::from_fn(|a| middle[a] + end * size[a]))
}

fn inside(p: &[f64; 2], area: &Area, margin: f64) -> bool {
    (0..2).all(|a| p[a] > area[0][a] - margin && p[a] < area[1][a] + margin)
}

fn overlap(a: &Area, b: &Area) -> bool {
    (0..2).all(|k| a[0][k] < b[1][k] && b[0][k] < a[1][k])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_of_dots_that_lie_together_lie_apart_and_hide_no_dot() {
        let within = [[0.0, 0.0], [400.0, 300.0]];
        // Four labels of dots within 8 px, in a cloud of others, one at the rim.
        let marked = [[200.0, 150.0], [206.0, 152.0], [203.0, 146.0], [396.0, 4.0]];
        let cloud = (0..60).map(|k| [150.0 + 7.0 * f64::from(k % 12), 120.0 + 9.0 * f64::from(k / 12)]);
        let line = (0..100).map(|k| [4.0 * f64::from(k), 140.0]);
        let dots: Vec<[f64; 2]> = cloud.chain(line).chain(marked).collect();
        let labels = marked.map(|dot| (dot, "tucker, T = 15".to_owned())).to_vec();
        let placed = place(labels, &dots, within);
        assert_eq!(placed.len(), 4);
        for (k, one) in placed.iter().enumerate() {
            assert!(placed[k + 1..].iter().all(|other| !overlap(&one.area, &other.area)), "{placed:?}");
            assert!(dots.iter().all(|d| !inside(d, &one.area, 0.0)), "{one:?} hides a dot");
            assert!((0..2).all(|a| one.area[0][a] >= 0.0 && one.area[1][a] <= within[1][a]), "{one:?}");
        }
    }

    #[test]
    fn a_label_alone_stands_right_of_its_dot() {
        let placed = place(vec![([50.0, 50.0], "a".into())], &[[50.0, 50.0]], [[0.0; 2], [200.0; 2]]);
        assert_eq!((placed[0].area[0][0], placed[0].area[0][1]), (59.0, 43.5));
    }
}
