//! Relighting.

use super::*;

fn relit(source: &Source, lights: &[Vec<[f64; 3]>]) -> Vec<Exitance> {
    let points = Quadrature::of_points(&lit_area(source).unwrap(), &source.shape());
    relight(source, &points, lights, &Progress::silent()).unwrap()
}

/// The largest difference of two images' samples.
fn apart(a: &Exitance, b: &Exitance) -> f64 {
    a.planes.iter().flatten().zip(b.planes.iter().flatten()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Sources of rows of every kind, each with the largest response.
fn sources(case: Case, scale: f64) -> Vec<(Source, f64, Option<Stored>)> {
    let mut all: Vec<(Source, f64, Option<Stored>)> = Vec::new();
    for kind in 0..KINDS {
        let mut m = material(case, kind);
        // What the response is in proportion to.
        let amounts = if m.header.degree.is_some() { &mut m.color_coefficients } else { &mut m.weights };
        amounts.iter_mut().for_each(|v| *v = (f64::from(*v) * scale) as f32);
        let size = (0..m.header.rows()).map(|i| formula(&m, i).1).fold(0.0, f64::max);
        all.push((source(&m), size, None));
    }
    let matrix = Matrix::coloured(case).with_gaps(case.seed).scaled(scale);
    let largest = matrix.rows.iter().flat_map(|r| &r.response).fold(0.0_f64, |a, &v| a.max(f64::from(v).abs()));
    let stored = matrix.stored();
    let reader = MatrixReader::open(stored.reader.path()).unwrap();
    all.push((Source::Matrix(Box::new(reader)), largest, Some(stored)));
    all
}

/// What relighting may be off by per unit of flux and of the largest response: sums of 5 terms, 42 rows and 4
/// neighbours; powers of a degree of up to 4 lose (1 + √2)⁴ = 34; transforms of some hundred samples, about as much.
/// All in f64.
const RELIGHTING: f64 = 1e3 * F64;

#[test]
fn relighting_is_linear_in_coloured_light_and_no_light_is_dark() {
    holds(12, (cases(), -30..=30_i32), |(case, decades)| {
        let mut draw = Draw::new(case.seed ^ 3);
        let n = case.points[0] * case.points[1];
        let mut flux = || if draw.chance(0.3) { [0.0; 3] } else { [0; 3].map(|_| draw.unit()) };
        let [one, other] = [0; 2].map(|_| (0..n).map(|_| flux()).collect::<Vec<_>>());
        let (a, b) = (draw.signed(), 3.0 * draw.signed());
        let both: Vec<[f64; 3]> = one.iter().zip(&other).map(|(l, m)| [0, 1, 2].map(|c| a * l[c] + b * m[c])).collect();
        let dark = vec![[0.0; 3]; n];
        for (source, largest, _stored) in sources(case, 10_f64.powi(decades)) {
            let together = relit(&source, &[one.clone(), other.clone(), both.clone(), dark.clone()]);
            let mut expected = Exitance::new(together[0].canvas);
            for c in 0..3 {
                let (one, other) = (&together[0].planes[c], &together[1].planes[c]);
                expected.planes[c] = one.iter().zip(other).map(|(l, m)| a * l + b * m).collect();
            }
            // One light may be convolved where four are not.
            let alone = relit(&source, std::slice::from_ref(&both));
            let tolerance = RELIGHTING * largest * 4.0 * n as f64;
            for found in [&together[2], &alone[0]] {
                let off = apart(found, &expected);
                assert!(off <= tolerance, "{:?}: {off:e}, expected {tolerance:e}", source.path());
            }
            assert!(together[3].planes.iter().flatten().all(|&v| v == 0.0));
        }
    });
}

#[test]
fn light_moved_by_a_point_moves_the_exitance_where_all_rows_are_the_same() {
    holds(12, cases(), |case| {
        let [nx, ny] = case.points;
        let mut draw = Draw::new(case.seed ^ 4);
        // Not on the last column or line, so that it can be moved by one.
        let inside = |i: usize| i % nx + 1 < nx.max(2) && i / nx + 1 < ny.max(2);
        let by = [usize::from(nx > 1), usize::from(ny > 1)];
        let light: Vec<[f64; 3]> =
            (0..nx * ny).map(|i| if inside(i) { [0; 3].map(|_| draw.unit()) } else { [0.0; 3] }).collect();
        let mut moved = vec![[0.0; 3]; nx * ny];
        (0..nx * ny).filter(|&i| inside(i)).for_each(|i| moved[i + by[0] + by[1] * nx] = light[i]);
        let mut all = Vec::new();
        for kind in 0..KINDS {
            let mut m = material(case, kind);
            let (n, terms) = (nx * ny, m.header.terms);
            let same = |values: &mut [f32], len: usize| {
                let first = values[..len].to_vec();
                values.chunks_exact_mut(len).for_each(|v| v.copy_from_slice(&first));
            };
            m.incident_factors.chunks_exact_mut(n * terms).for_each(|plane| same(plane, terms));
            if let Some(degree) = m.header.degree {
                same(&mut m.color_coefficients, 3 * (degree + 1));
            }
            m.shift = vec![m.shift[0]; n];
            // Two samples along x, three along y.
            m.header.pitch_mm = 0.5;
            m.lit_mm = (0..n).map(|i| [(i % nx) as f64, (i / nx) as f64 * 1.5]).collect();
            let size = formula(&m, 0).1;
            all.push((source(&m), size));
        }
        let mut matrix = Matrix::coloured(case);
        matrix.rows = vec![matrix.rows[0].clone(); nx * ny];
        let largest = matrix.rows[0].response.iter().fold(0.0_f32, |a, v| a.max(v.abs()));
        let stored = matrix.stored();
        let reader = MatrixReader::open(stored.reader.path()).unwrap();
        all.push((Source::Matrix(Box::new(reader)), f64::from(largest)));
        for (source, largest) in all {
            let [from, to] = relit(&source, &[light.clone(), moved.clone()]).try_into().unwrap();
            let mut expected = Exitance::new(from.canvas);
            let [width, height] = from.canvas.size;
            let [dx, dy] = [2 * by[0], 3 * by[1]];
            for (c, plane) in expected.planes.iter_mut().enumerate() {
                for (y, x) in (dy..height).flat_map(|y| (dx..width).map(move |x| (y, x))) {
                    plane[x + y * width] = from.planes[c][x - dx + (y - dy) * width];
                }
            }
            let (off, tolerance) = (apart(&to, &expected), RELIGHTING * largest * (nx * ny) as f64);
            assert!(off <= tolerance, "{off:e}, expected {tolerance:e}");
        }
    });
}
