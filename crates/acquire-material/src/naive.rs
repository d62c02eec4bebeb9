//! The formula of [`Material`] written down once more, as loops over points and offsets, and materials for tests on
//! which an exchanged axis, a wrong channel or a wrong sign shows.

use super::{ExitGrid, Material, MaterialHeader, Model};

/// Lit points along x and y.
pub(super) const POINTS: [usize; 2] = [5, 3];
/// Their number.
pub(super) const ROWS: usize = 15;
/// Samples of a window.
pub(super) const WINDOW: [usize; 2] = [7, 5];
/// Of the common window: a shift of 2 along x loses a column.
pub(super) const EXTENDED: [usize; 2] = [9, 7];
/// Side of a sample, mm.
pub(super) const PITCH_MM: f64 = 0.5;
/// Where the first lit point is, mm, and the steps to the next along each index: a lattice that is turned and sheared a
/// little.
pub(super) const ORIGIN_MM: [f64; 2] = [1.25, -2.0];
pub(super) const STEPS_MM: [[f64; 2]; 2] = [[0.75, 0.0625], [-0.03125, 1.0]];

/// Joint, non-negative with a profile, grey with a profile, and a cubic colour; positive and negative numbers of size
/// one.
pub(super) fn materials() -> Vec<Material> {
    let kinds = [
        (Model::Joint, [1, 3], false, None),
        (Model::Peers2006, [3, 3], true, None),
        (Model::Peers2006, [3, 1], false, None),
        (Model::Joint, [1, 1], true, None),
        (Model::Tucker, [1, 1], false, Some(3)),
        (Model::Peers2006, [1, 1], true, Some(2)),
    ];
    let plain = kinds.map(|(model, planes, profile, degree)| material(model, planes, profile, degree));
    let mut all = plain.to_vec();
    // A joint one, a grey one and a coloured one with entry and exit maps.
    for (of, planes) in [(0, 3), (3, 1), (5, 3)] {
        let mut m = plain[of].clone();
        let grid = ExitGrid { origin_mm: [0.25, -3.0], size: [13, 11], planes };
        m.header.exit_grid = Some(grid);
        m.entry_map = (0..planes * ROWS).map(|k| 1.0 + 0.4 * (0.9 * k as f32).sin()).collect();
        m.exit_map = (0..planes * 143).map(|k| 1.0 + 0.5 * (0.31 * k as f32).sin()).collect();
        all.push(m);
    }
    all
}

/// e_c at a place, mm.
pub(super) fn exit(m: &Material, c: usize, at: [f64; 2]) -> f64 {
    let Some(g) = m.header.exit_grid else { return 1.0 };
    let place = [0, 1].map(|a| ((at[a] - g.origin_mm[a]) / PITCH_MM).clamp(0.0, g.size[a] as f64 - 1.0));
    let mut sum = 0.0;
    for y in 0..g.size[1] {
        for x in 0..g.size[0] {
            let near = tent(place[0], x as f64) * tent(place[1], y as f64);
            sum += near * f64::from(m.exit_map[(c.min(g.planes - 1) * g.size[1] + y) * g.size[0] + x]);
        }
    }
    sum
}

/// a_c of a row.
pub(super) fn entry(m: &Material, c: usize, i: usize) -> f64 {
    m.header.exit_grid.map_or(1.0, |g| f64::from(m.entry_map[c.min(g.planes - 1) * ROWS + i]))
}

fn material(model: Model, [a, b]: [usize; 2], profile: bool, degree: Option<usize>) -> Material {
    let (terms, samples) = (3, EXTENDED[0] * EXTENDED[1]);
    let wave = |n: usize, f: f32, low: f32| (0..n).map(|k| low + (f * (k as f32 + 1.0)).sin()).collect::<Vec<f32>>();
    let lit = |k: usize, r: usize| {
        ORIGIN_MM[r] + (k % POINTS[0]) as f64 * STEPS_MM[0][r] + (k / POINTS[0]) as f64 * STEPS_MM[1][r]
    };
    Material {
        header: MaterialHeader {
            model,
            points: POINTS,
            window: WINDOW,
            pitch_mm: PITCH_MM,
            lit_pitch_mm: [0.75, 1.0],
            extended: EXTENDED,
            terms,
            incident_planes: a,
            offset_planes: b,
            shared_maps: None,
            profile,
            exit_grid: None,
            degree,
            intensity_range: [-0.75, 1.5],
            singular_values: vec![3.0, 1.0, 0.5],
            noise_level: 0.01,
            warnings: Vec::new(),
            provenance: serde_json::json!({}),
        },
        lit_mm: (0..ROWS).map(|k| [lit(k, 0), lit(k, 1)]).collect(),
        weights: vec![1.0, 0.625, -0.25],
        incident_factors: wave(a * ROWS * terms, 0.7, 0.3),
        offset_factors: wave(b * terms * samples, 0.37, 0.2).into(),
        profile: if profile { wave(b * samples, 0.23, 1.0) } else { Vec::new() },
        color_coefficients: degree.map_or(Vec::new(), |p| wave(ROWS * 3 * (p + 1), 1.1, 0.1)),
        entry_map: Vec::new(),
        exit_map: Vec::new(),
        // Points 6 and 7 and those below them are shifted alike, others not.
        shift: (0..ROWS)
            .map(|k| [[0, 0], [1, 0], [0, -1], [2, 1], [-1, 1], [0, 0], [-1, 0], [-1, 0], [1, -1], [0, 1]][k % 10])
            .map(|s: [i16; 2]| s)
            .collect(),
    }
}

/// v_k at a sample of the common window.
pub(super) fn plane(m: &Material, k: usize, i: usize, [ex, ey]: [usize; 2]) -> f64 {
    let h = &m.header;
    let (a, b) = (if h.incident_planes == 1 { 0 } else { k }, if h.offset_planes == 1 { 0 } else { k });
    let mut sum = 0.0;
    for j in 0..h.terms {
        let f = m.incident_factors[(a * ROWS + i) * h.terms + j];
        let map = m.offset_factors.all()[((b * h.terms + j) * EXTENDED[1] + ey) * EXTENDED[0] + ex];
        sum += f64::from(m.weights[j]) * f64::from(f) * f64::from(map);
    }
    if h.profile { sum * f64::from(m.profile[(b * EXTENDED[1] + ey) * EXTENDED[0] + ex]) } else { sum }
}

/// The sample of the common window at an offset of a row; `None` where nothing is modelled.
pub(super) fn sample(m: &Material, i: usize, d: [isize; 2]) -> Option<[usize; 2]> {
    let x = d[0] - isize::from(m.shift[i][0]) + 4;
    let y = d[1] - isize::from(m.shift[i][1]) + 3;
    ((0..9).contains(&x) && (0..7).contains(&y)).then_some([x as usize, y as usize])
}

/// Colours of the planes' values, for row i.
pub(super) fn colored(m: &Material, i: usize, planes: [f64; 3]) -> [f64; 3] {
    let Some(degree) = m.header.degree else { return planes };
    let [low, high] = m.header.intensity_range.map(f64::from);
    let u = ((2.0 * planes[0] - low - high) / (high - low)).clamp(-1.0, 1.0);
    let legendre = [1.0, u, (3.0 * u * u - 1.0) / 2.0, (5.0 * u * u * u - 3.0 * u) / 2.0];
    [0, 1, 2].map(|c| {
        let beta = |p: usize| f64::from(m.color_coefficients[(i * 3 + c) * (degree + 1) + p]);
        (0..=degree).map(|p| beta(p) * legendre[p]).sum()
    })
}

/// The three planes, a single one repeated.
pub(super) fn planes(m: &Material, i: usize, e: [usize; 2]) -> [f64; 3] {
    let one = m.header.incident_planes.max(m.header.offset_planes) == 1;
    [0, 1, 2].map(|k| plane(m, if one { 0 } else { k }, i, e))
}

/// R̂_d at an offset of a row's window; `None` outside the window.
pub(super) fn response(m: &Material, i: usize, d: [isize; 2]) -> Option<[f64; 3]> {
    let at = [0, 1].map(|a| m.lit_mm[i][a] + d[a] as f64 * PITCH_MM);
    inner(m, i, d).map(|v| [0, 1, 2].map(|c| v[c] * exit(m, c, at)))
}

/// The same before it leaves through the exit map.
pub(super) fn inner(m: &Material, i: usize, d: [isize; 2]) -> Option<[f64; 3]> {
    let colors = || sample(m, i, d).map_or([0.0; 3], |e| colored(m, i, planes(m, i, e)));
    (d[0].abs() <= 3 && d[1].abs() <= 2).then(colors).map(|v| [0, 1, 2].map(|c| v[c] * entry(m, c, i)))
}

/// All offsets of a window, line by line.
pub(super) fn offsets() -> impl Iterator<Item = [isize; 2]> {
    (-2..=2).flat_map(|y| (-3..=3).map(move |x| [x, y]))
}

/// How much a sample at `at` adds to one at whole number `k`, both in steps: linear between neighbours.
pub(super) fn tent(at: f64, k: f64) -> f64 {
    (1.0 - (at - k).abs()).max(0.0)
}
