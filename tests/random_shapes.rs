//! What holds for every matrix and every material, tried on random shapes and values: few points and small windows that are not square,
//! displaced peaks, entries and rows that were not measured, rows of zeros, numbers from 1e-30 to 1e30.
//!
//! The shapes are the same at every run. `PROPTEST_RNG_SEED=2 PROPTEST_CASES=500` tries others.

use acquire::Warning;
use acquire::evaluate::{Measures, evaluate};
use acquire::factor::{Backend, Factored, Goal, Options, factor};
use acquire::material::coded::{self, Quality};
use acquire::material::{Evaluator, Exitance, Material, MaterialHeader, Model, SharedBasis, Source};
use acquire::material::{export_npz, relight};
use acquire::progress::Progress;
use acquire::transport::{MatrixHeader, MatrixReader, MatrixWriter, Row, ShotRecord};
use proptest::prelude::*;
use proptest::test_runner::{RngSeed, TestRunner};
use rand::{Rng, SeedableRng};
use std::io::Read;
use std::path::Path;

/// Half the distance of neighbouring numbers, relative: what rounding changes at most.
const F32: f64 = f32::EPSILON as f64 / 2.0;
const F64: f64 = f64::EPSILON / 2.0;

/// Tries a property on random inputs; the first that breaks it is made smaller and printed.
fn holds<S: Strategy>(cases: u32, inputs: S, property: impl Fn(S::Value)) {
    // Of the environment, if it says so; a file of failures is not kept, their shapes belong into tests of their own.
    let mut config = ProptestConfig { failure_persistence: None, ..ProptestConfig::default() };
    if std::env::var_os("PROPTEST_CASES").is_none() {
        config.cases = cases;
    }
    if config.rng_seed == RngSeed::Random {
        config.rng_seed = RngSeed::Fixed(1);
    }
    let mut runner = TestRunner::new(config);
    let found = runner.run(&inputs, |input| {
        property(input);
        Ok(())
    });
    if let Err(broken) = found {
        panic!("{broken}");
    }
}

/// Points, a window, and the seed of everything else.
#[derive(Debug, Clone, Copy)]
struct Case {
    points: [usize; 2],
    window: [usize; 2],
    seed: u64,
}

fn cases() -> impl Strategy<Value = Case> {
    let odd = || (0_usize..4).prop_map(|k| 2 * k + 1);
    ([1_usize..=7, 1..=6], [odd(), odd()], any::<u64>().no_shrink()).prop_map(|(points, window, seed)| Case {
        points,
        window,
        seed,
    })
}

/// Random numbers of a seed.
struct Draw(rand_pcg::Pcg64);

impl Draw {
    fn new(seed: u64) -> Self {
        Self(rand_pcg::Pcg64::seed_from_u64(seed))
    }

    /// Uniform from 0 to 1.
    fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Uniform from −1 to 1.
    fn signed(&mut self) -> f64 {
        2.0 * self.unit() - 1.0
    }

    fn below(&mut self, n: usize) -> usize {
        (self.unit() * n as f64) as usize
    }

    fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    fn f32s(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.signed() as f32).collect()
    }

    /// Any f32 that is finite, subnormal and negative zero too.
    fn bits(&mut self) -> f32 {
        let v = f32::from_bits(self.0.next_u32());
        if v.is_finite() { v } else { -0.0 }
    }

    /// Numbers below n in another order.
    fn order(&mut self, n: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..n).collect();
        (1..n).rev().for_each(|k| order.swap(k, self.below(k + 1)));
        order
    }
}

/// A matrix in memory.
#[derive(Debug, Clone)]
struct Matrix {
    header: MatrixHeader,
    rows: Vec<Row>,
}

/// A matrix on disk.
struct Stored {
    _folder: tempfile::TempDir,
    reader: MatrixReader,
}

/// Of a window's numbers: the sample along x and y, and the channel.
fn place(k: usize, window: [usize; 2]) -> ([usize; 2], usize) {
    ([k / 3 % window[0], k / 3 / window[0]], k % 3)
}

impl Matrix {
    /// `response(row, sample, channel)`, without variance, all measured; points stand at every second sample along x and every third along y.
    fn of(points: [usize; 2], window: [usize; 2], mut response: impl FnMut(usize, [usize; 2], usize) -> f64) -> Self {
        let n = points[0] * points[1];
        let header = MatrixHeader {
            points,
            window,
            pitch_mm: 0.5,
            lit_pitch_mm: [1.0, 1.5],
            lit_mm: (0..n).map(|i| [(i % points[0]) as f64, (i / points[0]) as f64 * 1.5]).collect(),
            position_sd_mm: vec![0.0; n],
            shot_of: vec![None; n],
            shots: Vec::new(),
            warnings: Vec::new(),
            provenance: serde_json::json!({}),
        };
        let len = header.row_len();
        let mut row = |i| Row {
            response: (0..len)
                .map(|k| {
                    let (sample, c) = place(k, window);
                    response(i, sample, c) as f32
                })
                .collect(),
            variance: vec![0.0; len],
            valid: vec![true; len],
        };
        Self { rows: (0..n).map(&mut row).collect(), header }
    }

    /// Bells of three widths, each point and channel with its own amounts of them, a twentieth of noise; of some rows the peak is displaced.
    fn coloured(case: Case) -> Self {
        let mut draw = Draw::new(case.seed);
        let n = case.points[0] * case.points[1];
        let amounts: Vec<[[f64; 3]; 3]> = (0..n).map(|_| [0; 3].map(|_| [0; 3].map(|_| 0.2 + draw.unit()))).collect();
        let peaks: Vec<[f64; 2]> = (0..n).map(|_| [0; 2].map(|_| [-1.0, 0.0, 0.0, 1.0][draw.below(4)])).collect();
        Self::of(case.points, case.window, |i, s, c| {
            let d = [0, 1].map(|a| s[a] as f64 - (case.window[a] / 2) as f64 - peaks[i][a]);
            let bell = |width: f64| (-(d[0] * d[0] + d[1] * d[1]) / (2.0 * width * width)).exp();
            let smooth: f64 = (0..3).map(|j| amounts[i][c][j] * bell([0.6, 1.2, 3.0][j])).sum();
            smooth * (1.0 + 0.05 * draw.signed())
        })
    }

    /// Takes out single entries, all of some rows, and makes some rows zero.
    fn with_gaps(mut self, seed: u64) -> Self {
        let mut draw = Draw::new(seed ^ 1);
        for row in &mut self.rows {
            let (unlit, zero) = (draw.chance(0.05), draw.chance(0.1));
            for (valid, v) in row.valid.iter_mut().zip(&mut row.response) {
                *valid = !unlit && !draw.chance(0.05);
                if zero || !*valid {
                    *v = 0.0;
                }
            }
        }
        self
    }

    fn scaled(mut self, scale: f64) -> Self {
        self.rows.iter_mut().flat_map(|r| &mut r.response).for_each(|v| *v = (f64::from(*v) * scale) as f32);
        self.rows.iter_mut().flat_map(|r| &mut r.variance).for_each(|v| *v = (f64::from(*v) * scale * scale) as f32);
        self
    }

    fn stored(&self) -> Stored {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.rd.zarr");
        let writer = MatrixWriter::create(&path, self.header.clone()).unwrap();
        self.rows.iter().enumerate().for_each(|(i, row)| writer.put(i, row).unwrap());
        writer.finish().unwrap();
        Stored { reader: MatrixReader::open(&path).unwrap(), _folder: folder }
    }

    fn factored(&self, options: &Options) -> Factored {
        factor(&self.stored().reader, options, &Progress::silent()).unwrap()
    }

    /// Σ of squares over measured entries.
    fn energy(&self) -> f64 {
        self.error(&vec![vec![0.0; self.header.row_len()]; self.rows.len()])
    }

    /// Σ of squared differences from it, over measured entries.
    fn error(&self, fit: &[Vec<f32>]) -> f64 {
        let one = |(row, fit): (&Row, &Vec<f32>)| -> f64 {
            let entries = row.response.iter().zip(fit).zip(&row.valid).filter(|(_, v)| **v);
            entries.map(|((&a, &b), _)| (f64::from(a) - f64::from(b)).powi(2)).sum()
        };
        self.rows.iter().zip(fit).map(one).sum()
    }

    /// Rows of `points` points from `first` on, the middle `window` of each.
    fn crop(&self, first: [usize; 2], points: [usize; 2], window: [usize; 2]) -> Self {
        let cropped = |rows: &dyn Fn(usize) -> Vec<f32>| crop(&self.header, rows, first, points, window);
        let mut out = Self::of(points, window, |_, _, _| 0.0);
        let response = cropped(&|i| self.rows[i].response.clone());
        let valid = cropped(&|i| self.rows[i].valid.iter().map(|&v| f32::from(u8::from(v))).collect());
        for ((row, response), valid) in out.rows.iter_mut().zip(response).zip(valid) {
            (row.response, row.valid) = (response, valid.iter().map(|&v| v == 1.0).collect());
        }
        out
    }
}

fn crop(
    header: &MatrixHeader,
    rows: impl Fn(usize) -> Vec<f32>,
    first: [usize; 2],
    points: [usize; 2],
    window: [usize; 2],
) -> Vec<Vec<f32>> {
    let rim = [0, 1].map(|a| (header.window[a] - window[a]) / 2);
    let row = |i: usize| {
        let from = rows(first[0] + i % points[0] + (first[1] + i / points[0]) * header.points[0]);
        let entry = |k| {
            let ([x, y], c) = place(k, window);
            from[(x + rim[0] + (y + rim[1]) * header.window[0]) * 3 + c]
        };
        (0..window[0] * window[1] * 3).map(entry).collect()
    };
    (0..points[0] * points[1]).map(row).collect()
}

fn rows_of(material: &Material) -> Vec<Vec<f32>> {
    (0..material.header.rows()).map(|i| material.evaluate_row(i)).collect()
}

fn joint(terms: usize) -> Options {
    Options { model: Some(Model::Joint), terms: Some(terms), backend: Some(Backend::Full), ..Options::default() }
}

/// What storing `terms` orthonormal terms as f32 changes, over ‖R‖: rows are divided by the peak, then weights, both factors, shared maps and
/// their amounts, and what comes out are rounded once each, which differs for every term, and as many terms may be left out as are no larger
/// than rounding.
fn storing(terms: usize) -> f64 {
    F32 * (2.0 + 6.0 * (terms as f64).sqrt())
}

/// A material of random numbers of size one. Kinds: all planes one's own or shared on either side, with a profile or not, shared maps,
/// polynomials.
fn material(case: Case, kind: usize) -> Material {
    let mut draw = Draw::new(case.seed ^ 2);
    let (model, [a, b], profile, degree) = [
        (Model::Joint, [1, 3], false, None),
        (Model::Joint, [1, 3], false, None),
        (Model::Joint, [1, 1], false, None),
        (Model::Peers2006, [3, 3], true, None),
        (Model::Peers2006, [3, 1], false, None),
        (Model::Peers2006, [1, 1], true, None),
        (Model::Tucker, [1, 1], false, Some(draw.below(5))),
        (Model::Peers2006, [1, 1], true, Some(draw.below(3))),
    ][kind % KINDS];
    let Case { points, window, .. } = case;
    let terms = 1 + draw.below(5);
    // A shift may leave the common window, which then models nothing there.
    let extended = window.map(|w| w + 2 * draw.below(2));
    let (n, samples) = (points[0] * points[1], extended[0] * extended[1]);
    let shared_maps = (kind % KINDS == 1).then(|| 1 + draw.below(3 * terms));
    let shared = shared_maps.map(|maps| SharedBasis {
        maps,
        vectors: draw.f32s(maps * samples),
        core: draw.f32s(b * terms * maps),
    });
    let offset_factors = match &shared {
        Some(s) => (0..b * terms * samples)
            .map(|k| {
                let amount = |l: usize| f64::from(s.core[k / samples * s.maps + l]);
                (0..s.maps).map(|l| amount(l) * f64::from(s.vectors[l * samples + k % samples])).sum::<f64>() as f32
            })
            .collect(),
        None => draw.f32s(b * terms * samples),
    };
    Material {
        header: MaterialHeader {
            model,
            points,
            window,
            pitch_mm: 0.2 + draw.unit(),
            lit_pitch_mm: [0.2 + draw.unit(), 0.2 + draw.unit()],
            extended,
            terms,
            incident_planes: a,
            offset_planes: b,
            shared_maps,
            profile,
            degree,
            intensity_range: [-0.5 - draw.unit() as f32, 0.5 + draw.unit() as f32],
            singular_values: (0..terms).map(|_| draw.unit()).collect(),
            noise_level: draw.unit(),
            warnings: vec![Warning::EmptyRows { rows: draw.below(9) }],
            provenance: serde_json::json!({"seed": case.seed, "nested": {"number": draw.signed(), "none": null}}),
        },
        lit_mm: (0..n)
            .map(|i| [i % points[0], i / points[0]].map(|k| f64::from((k as f64 + 0.2 * draw.signed()) as f32)))
            .collect(),
        weights: draw.f32s(terms),
        incident_factors: draw.f32s(a * n * terms),
        offset_factors,
        shared,
        profile: draw.f32s(if profile { b * samples } else { 0 }),
        color_coefficients: draw.f32s(degree.map_or(0, |p| n * 3 * (p + 1))),
        shift: (0..n).map(|_| window.map(|w| draw.below(w) as i16 - (w / 2) as i16)).collect(),
    }
}

const KINDS: usize = 8;

/// Row `i` by the formula of docs/materials.md, and what an error of each rounding may be relative to: Σ |g f h m|, and where polynomials make
/// colours of it Σ |β_p| (1 + p² · 2 Σ |g f h m| / (range)), as |dL_p/du| ≤ p².
fn formula(m: &Material, i: usize) -> (Vec<[f64; 3]>, f64) {
    let h = &m.header;
    let samples = h.extended[0] * h.extended[1];
    let [low, high] = h.intensity_range.map(f64::from);
    let (mut row, mut size) = (Vec::new(), 0.0_f64);
    for k in 0..h.window[0] * h.window[1] {
        let sample = [k % h.window[0], k / h.window[0]];
        let on = |a: usize| {
            let e = sample[a] as isize - (h.window[a] / 2) as isize - isize::from(m.shift[i][a])
                + (h.extended[a] / 2) as isize;
            (0..h.extended[a] as isize).contains(&e).then_some(e as usize)
        };
        let (Some(x), Some(y)) = (on(0), on(1)) else {
            row.push([0.0; 3]);
            continue;
        };
        let e = x + y * h.extended[0];
        let planes = [0, 1, 2].map(|p| {
            let (a, b) = (p.min(h.incident_planes - 1), p.min(h.offset_planes - 1));
            let profile = if h.profile { f64::from(m.profile[b * samples + e]) } else { 1.0 };
            let product = |j: usize| {
                let f = m.incident_factors[(a * h.rows() + i) * h.terms + j];
                f64::from(m.weights[j])
                    * f64::from(f)
                    * f64::from(m.offset_factors[(b * h.terms + j) * samples + e])
                    * profile
            };
            (0..h.terms).fold((0.0, 0.0), |(v, s), j| (v + product(j), s + product(j).abs()))
        });
        let Some(degree) = h.degree else {
            size = planes.iter().fold(size, |s, p| s.max(p.1));
            row.push(planes.map(|p| p.0));
            continue;
        };
        let (value, terms) = planes[0];
        let u = ((2.0 * value - low - high) / (high - low)).clamp(-1.0, 1.0);
        let mut legendre = vec![1.0, u];
        (1..degree).for_each(|p| {
            let n = p as f64;
            legendre.push(((2.0 * n + 1.0) * u * legendre[p] - n * legendre[p - 1]) / (n + 1.0));
        });
        row.push([0, 1, 2].map(|c| {
            let beta = |p: usize| f64::from(m.color_coefficients[(i * 3 + c) * (degree + 1) + p]);
            let slope = |p: usize| 1.0 + (p * p) as f64 * 2.0 * terms / (high - low);
            size = size.max((0..=degree).map(|p| beta(p).abs() * slope(p)).sum());
            (0..=degree).map(|p| beta(p) * legendre[p]).sum()
        }));
    }
    (row, size)
}

fn source(material: &Material) -> Source {
    Source::Material(Box::new(material.clone()), "m".into())
}

fn relit(source: &Source, lights: &[Vec<[f64; 3]>]) -> Vec<Exitance> {
    relight(source, lights, &Progress::silent()).unwrap()
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

/// What relighting may be off by per unit of flux and of the largest response: sums of 5 terms, 42 rows and 4 neighbours; powers of a degree of
/// up to 4 lose (1 + √2)⁴ = 34; transforms of some hundred samples, about as much. All in f64.
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

#[test]
fn a_matrix_comes_back_from_the_store_to_the_last_bit() {
    // Windows of a megabyte: lines of points take several chunks.
    let large = (any::<u64>().no_shrink(), 5_usize..=7).prop_map(|(seed, nx)| Case {
        points: [nx, 1],
        window: [403, 301],
        seed,
    });
    holds(12, prop_oneof![5 => cases(), 1 => large], |case| {
        let mut draw = Draw::new(case.seed ^ 5);
        let mut matrix = Matrix::of(case.points, case.window, |_, _, _| 0.0);
        let n = matrix.rows.len();
        for row in &mut matrix.rows {
            row.response.iter_mut().for_each(|v| *v = draw.bits());
            row.variance.iter_mut().for_each(|v| *v = draw.bits().abs());
            row.valid.iter_mut().for_each(|v| *v = draw.chance(0.8));
        }
        let h = &mut matrix.header;
        let shots = 1 + draw.below(4);
        h.pitch_mm = draw.unit() + 1e-3;
        h.lit_pitch_mm = [draw.unit() + 1e-3, 1e3 * draw.unit() + 1e-3];
        h.lit_mm = (0..n).map(|_| [1e3 * draw.signed(), draw.signed()]).collect();
        h.position_sd_mm = (0..n).map(|_| draw.unit()).collect();
        h.shot_of = (0..n).map(|_| draw.chance(0.8).then(|| draw.below(shots))).collect();
        h.shots = (0..shots)
            .map(|k| ShotRecord {
                name: format!("lattice \"{k}\" µ"),
                drift_px: [draw.signed(), draw.signed()],
                drift_sd_px: draw.chance(0.5).then(|| draw.unit()),
            })
            .collect();
        h.warnings = vec![Warning::UnlitPoints { rows: draw.below(9) }];
        h.provenance = serde_json::json!({"seed": case.seed, "list": [draw.signed(), null, "text"]});
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.rd.zarr");
        let writer = MatrixWriter::create(&path, matrix.header.clone()).unwrap();
        let len = matrix.header.row_len();
        let never = Row { response: vec![0.0; len], variance: vec![0.0; len], valid: vec![false; len] };
        for i in draw.order(n) {
            if draw.chance(0.1) {
                matrix.rows[i] = never.clone();
                continue;
            }
            // The last of those that are put counts.
            if draw.chance(0.2) {
                writer.put(i, &matrix.rows[draw.below(n)]).unwrap();
            }
            writer.put(i, &matrix.rows[i]).unwrap();
        }
        writer.finish().unwrap();
        let reader = MatrixReader::open(&path).unwrap();
        assert_eq!(reader.header(), &matrix.header);
        for first in 0..n {
            let range = first..first + 1 + draw.below(n - first);
            if case.window[0] > 7 && first > 1 {
                break;
            }
            let rows = &matrix.rows[range.clone()];
            let (all, part) = (reader.read(range.clone()).unwrap(), reader.read_responses(range).unwrap());
            let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            let response = rows.iter().flat_map(|r| bits(&r.response)).collect::<Vec<_>>();
            assert!(bits(&all.response) == response && bits(&part.response) == response, "responses from {first}");
            assert!(bits(&all.variance) == rows.iter().flat_map(|r| bits(&r.variance)).collect::<Vec<_>>());
            let valid = rows.iter().flat_map(|r| r.valid.iter().map(|&v| u8::from(v))).collect::<Vec<_>>();
            assert!(all.valid == valid && part.valid == valid && part.variance.is_empty());
        }
    });
}

/// All numbers of a material, as bits: zeros have signs.
fn bits(m: &Material) -> Vec<Vec<u32>> {
    let shared = m.shared.as_ref();
    let (vectors, core) = shared.map_or((&[][..], &[][..]), |s| (&s.vectors[..], &s.core[..]));
    let all: [&[f32]; 7] =
        [&m.weights, &m.incident_factors, &m.offset_factors, &m.profile, &m.color_coefficients, vectors, core];
    all.into_iter().map(|values| values.iter().map(|v| v.to_bits()).collect()).collect()
}

#[test]
fn a_material_comes_back_from_its_file_to_the_last_bit() {
    holds(32, (cases(), 0..KINDS), |(case, kind)| {
        let mut draw = Draw::new(case.seed ^ 6);
        let mut m = material(case, kind);
        let of_shared = m.shared.is_some();
        let offsets = if of_shared { &mut Vec::new() } else { &mut m.offset_factors };
        let numbers = [&mut m.weights, &mut m.incident_factors, offsets, &mut m.profile, &mut m.color_coefficients];
        // Files hold no number above 1e36.
        for v in numbers.into_iter().flatten() {
            if draw.chance(0.5) {
                *v = Some(draw.bits()).filter(|v| v.abs() <= 1e36).unwrap_or(-0.0);
            }
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.safetensors");
        m.save(&path).unwrap();
        let once = Material::load(&path).unwrap();
        if of_shared {
            // Sums of at most 15 maps of size one in f64, rounded to f32: two orders of summing may round to neighbours.
            let pairs = m.offset_factors.iter().zip(&once.offset_factors);
            assert!(
                pairs.into_iter().all(|(a, b)| f64::from(a - b).abs() <= 2.0 * F32 * f64::from(a.abs()) + 15.0 * F64)
            );
            m.offset_factors = once.offset_factors.clone();
        }
        assert_eq!(once, m);
        assert_eq!(bits(&once), bits(&m));
        once.save(&path).unwrap();
        let twice = Material::load(&path).unwrap();
        assert_eq!((bits(&twice), &twice), (bits(&once), &once));
    });
}

#[test]
fn a_coded_material_comes_back_as_the_encoder_said() {
    holds(12, (cases(), 0..KINDS, 1.0..4.5_f64), |(case, kind, digits)| {
        let m = material(case, kind);
        let asked = 10_f64.powf(-digits);
        let options = coded::Options { quality: Quality::AddedError(asked), ..coded::Options::default() };
        let coded = coded::encode(&m, &options).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.acq");
        coded.save(&path).unwrap();
        let once = Material::load(&path).unwrap();
        assert_eq!((bits(&once), &once), (bits(&coded.material), &coded.material));
        let (a, b) = (rows_of(&m), rows_of(&once));
        let squares = |f: &dyn Fn(f32, f32) -> f64| -> f64 {
            a.iter().flatten().zip(b.iter().flatten()).map(|(&a, &b)| f(a, b).powi(2)).sum()
        };
        let (off, size) = (squares(&|a, b| f64::from(a) - f64::from(b)).sqrt(), squares(&|a, _| a.into()).sqrt());
        assert!(coded.added_error <= asked);
        // Rows are rounded to f32 here.
        assert!((off - coded.added_error * size).abs() <= 2.0 * F32 * size, "{off} of {size}, {}", coded.added_error);
        let plain = folder.path().join("m.safetensors");
        once.save(&plain).unwrap();
        let twice = Material::load(&plain).unwrap();
        assert_eq!((bits(&twice), &twice.header, &twice.shift), (bits(&once), &once.header, &once.shift));
        let places = twice.lit_mm.as_flattened().iter().zip(once.lit_mm.as_flattened());
        assert!({ places }.all(|(a, b)| *a == f64::from(*b as f32)), "places are f32 in a plain file");
    });
}

#[test]
fn as_many_terms_as_a_matrix_has_reproduce_it_and_any_crop_of_it() {
    holds(12, (cases(), -30..=30_i32), |(case, decades)| {
        let mut draw = Draw::new(case.seed ^ 7);
        let matrix = Matrix::coloured(case).with_gaps(case.seed).scaled(10_f64.powi(decades));
        let points = case.points.map(|n| 1 + draw.below(n));
        let first = [0, 1].map(|a| draw.below(case.points[a] - points[a] + 1));
        let window = case.window.map(|w| w - 2 * draw.below(w / 2 + 1));
        for part in [matrix.crop(first, points, window), matrix] {
            let terms = part.rows.len();
            let options = Options { peak_shift: draw.chance(0.7), ..joint(terms) };
            let f = part.factored(&options);
            let energy = part.energy();
            let error = (part.error(&rows_of(&f.material)) / energy.max(f64::MIN_POSITIVE)).sqrt();
            // Gaps of a shifted row are filled with what may be larger than what was measured, by a few times.
            let tolerance = 4.0 * storing(terms);
            assert!(error <= tolerance, "{error:e} of {tolerance:e}, {}", f.choice);
            assert!((error - f.rel_rmse).abs() <= tolerance, "{error:e} {:e}", f.rel_rmse);
        }
    });
}

/// A matrix of products of two random factors, and the number of them.
fn low_rank(case: Case) -> (Matrix, usize) {
    let mut draw = Draw::new(case.seed ^ 8);
    let n = case.points[0] * case.points[1];
    let len = case.window[0] * case.window[1] * 3;
    let rank = 1 + draw.below(3);
    let incident: Vec<f64> = (0..n * rank).map(|_| draw.signed()).collect();
    let offset: Vec<f64> = (0..len * rank).map(|_| draw.signed()).collect();
    let matrix = Matrix::of(case.points, case.window, |i, [x, y], c| {
        let k = (x + y * case.window[0]) * 3 + c;
        (0..rank).map(|j| incident[i * rank + j] * offset[k * rank + j]).sum()
    });
    (matrix, rank)
}

#[test]
fn a_crop_of_a_matrix_of_low_rank_and_its_rows_in_any_order_take_as_many_terms() {
    holds(10, cases(), |case| {
        let mut draw = Draw::new(case.seed ^ 9);
        let (matrix, rank) = low_rank(case);
        let points = case.points.map(|n| 1 + draw.below(n));
        let first = [0, 1].map(|a| draw.below(case.points[a] - points[a] + 1));
        let window = case.window.map(|w| w - 2 * draw.below(w / 2 + 1));
        let order = draw.order(matrix.rows.len());
        let other = Matrix { rows: order.iter().map(|&i| matrix.rows[i].clone()).collect(), ..matrix.clone() };
        let options = Options { peak_shift: false, ..joint(rank) };
        let mut values = Vec::new();
        for part in [matrix.crop(first, points, window), matrix, other] {
            let f = part.factored(&options);
            let error = (part.error(&rows_of(&f.material)) / part.energy()).sqrt();
            // Entries are rounded to f32, which the terms need not follow.
            let tolerance = storing(rank) + F32;
            assert!(error <= tolerance, "{error:e} of {tolerance:e}, {}", f.choice);
            values.push(f.material.header.singular_values);
        }
        // They are roots of products in f64, of up to 42 rows and some times as many steps of the decomposition.
        let tolerance = 1e3 * F64 * values[1][0].powi(2);
        assert!(values[1].iter().zip(&values[2]).all(|(a, b)| (a * a - b * b).abs() <= tolerance), "{values:?}");
    });
}

#[test]
fn a_crop_is_factored_no_worse_than_the_factored_matrix_is_cropped() {
    holds(10, cases(), |case| {
        let mut draw = Draw::new(case.seed ^ 10);
        let matrix = Matrix::coloured(case);
        let points = case.points.map(|n| 1 + draw.below(n));
        let first = [0, 1].map(|a| draw.below(case.points[a] - points[a] + 1));
        let window = case.window.map(|w| w - 2 * draw.below(w / 2 + 1));
        let terms = 1 + draw.below(4);
        let options = Options { peak_shift: false, ..joint(terms) };
        let whole = rows_of(&matrix.factored(&options).material);
        let part = matrix.crop(first, points, window);
        let cropped = crop(&matrix.header, |i| whole[i].clone(), first, points, window);
        let own = part.error(&rows_of(&part.factored(&options).material)).sqrt();
        let (of_whole, size) = (part.error(&cropped).sqrt(), part.energy().sqrt());
        // Sharing maps may add a hundredth to the squared error; beyond it the best of that rank is not worse than any other of that rank.
        let tolerance = 1.01_f64.sqrt() * of_whole + storing(terms) * size;
        assert!(own <= tolerance, "{own:e}, cropped {of_whole:e} of {size:e}");
    });
}

/// What may be done to a matrix and to a material's rows alike.
#[derive(Debug, Clone, Copy)]
enum Change {
    Channels([usize; 3]),
    Mirror(usize),
    Transpose,
}

fn changes() -> impl Strategy<Value = Change> {
    let orders = [[0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    prop_oneof![
        proptest::sample::select(orders.to_vec()).prop_map(Change::Channels),
        (0_usize..2).prop_map(Change::Mirror),
        Just(Change::Transpose),
    ]
}

impl Change {
    fn axes<T: Copy>(self, v: [T; 2]) -> [T; 2] {
        if matches!(self, Self::Transpose) { [v[1], v[0]] } else { v }
    }

    /// The number that comes to `at` of a grid of `size`.
    fn from(self, at: [usize; 2], size: [usize; 2]) -> usize {
        let [x, y] = match self {
            Self::Mirror(0) => [size[0] - 1 - at[0], at[1]],
            Self::Mirror(_) => [at[0], size[1] - 1 - at[1]],
            _ => self.axes(at),
        };
        let width = self.axes(size)[0];
        x + y * width
    }

    /// Rows with entries `[dy][dx][channel]` of a header, changed.
    fn rows<T: Copy>(self, rows: &[Vec<T>], points: [usize; 2], window: [usize; 2]) -> Vec<Vec<T>> {
        let (points, window) = (self.axes(points), self.axes(window));
        let channel = |c: usize| if let Self::Channels(order) = self { order[c] } else { c };
        let row = |i: usize| {
            let from = &rows[self.from([i % points[0], i / points[0]], points)];
            let entry = |k: usize| {
                let (sample, c) = place(k, window);
                from[self.from(sample, window) * 3 + channel(c)]
            };
            (0..window[0] * window[1] * 3).map(entry).collect()
        };
        (0..points[0] * points[1]).map(row).collect()
    }

    fn matrix(self, m: &Matrix) -> Matrix {
        let (points, window) = (m.header.points, m.header.window);
        let mut out = Matrix::of(self.axes(points), self.axes(window), |_, _, _| 0.0);
        out.header.lit_pitch_mm = self.axes(m.header.lit_pitch_mm);
        let position = |i: usize| self.axes(m.header.lit_mm[i]);
        let [nx, ny] = out.header.points;
        let place = |i: usize| position(self.from([i % nx, i / nx], [nx, ny]));
        let far =
            [m.header.lit_pitch_mm[0] * (points[0] - 1) as f64, m.header.lit_pitch_mm[1] * (points[1] - 1) as f64];
        out.header.lit_mm = (0..nx * ny).map(place).collect();
        if let Self::Mirror(a) = self {
            out.header.lit_mm.iter_mut().for_each(|p| p[a] = far[a] - p[a]);
        }
        let all =
            |get: &dyn Fn(&Row) -> Vec<f32>| self.rows(&m.rows.iter().map(get).collect::<Vec<_>>(), points, window);
        let valid: Vec<Vec<bool>> = m.rows.iter().map(|r| r.valid.clone()).collect();
        let (response, variance) = (all(&|r| r.response.clone()), all(&|r| r.variance.clone()));
        let rows = response.into_iter().zip(variance).zip(self.rows(&valid, points, window));
        out.rows = rows.map(|((response, variance), valid)| Row { response, variance, valid }).collect();
        out
    }
}

#[test]
fn a_changed_matrix_is_factored_to_the_changed_material() {
    holds(20, (cases(), changes(), any::<bool>()), |(case, change, tucker)| {
        let mut draw = Draw::new(case.seed ^ 11);
        let matrix = Matrix::coloured(case);
        let terms = 1 + draw.below(4);
        let options = match tucker {
            true => Options { model: Some(Model::Tucker), degree: Some(draw.below(4)), ..joint(terms) },
            false => joint(terms),
        };
        let (f, g) = (matrix.factored(&options), change.matrix(&matrix).factored(&options));
        let (a, b) = (&f.material.header, &g.material.header);
        assert_eq!((change.axes(a.extended), a.terms, a.shared_maps), (b.extended, b.terms, b.shared_maps));
        let expected = change.rows(&rows_of(&f.material), case.points, case.window);
        let found = rows_of(&g.material);
        let size = matrix.energy().sqrt();
        let off: f64 =
            expected.iter().flatten().zip(found.iter().flatten()).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        // What is known to rounding turns terms by as much over the distance of the last singular value that is kept to the first that is
        // not. A polynomial of degree 3 on a row whose intensities lie close together magnifies that.
        let [last, next] =
            [terms - 1, terms].map(|j| a.singular_values.get(j).copied().unwrap_or(0.0) / a.singular_values[0]);
        let turned = if next > 0.0 { 1.0 / (last - next).max(F64) } else { 1.0 };
        let magnified = if tucker { 30.0 } else { 1.0 };
        let tolerance = magnified * (2.0 * storing(terms) + F32 * turned);
        assert!(off.sqrt() <= tolerance * size, "{:e} of {tolerance:e}, {}", off.sqrt() / size, f.choice);
        assert!((f.rel_rmse - g.rel_rmse).abs() <= tolerance, "{} {}", f.rel_rmse, g.rel_rmse);
    });
}

#[test]
fn a_matrix_times_a_power_of_two_is_factored_to_the_material_times_it_to_the_last_bit() {
    let ways = |way: usize, terms: usize| {
        let base = Options { terms: Some(terms), ..Options::default() };
        let (tucker, peers) = (Some(Model::Tucker), Some(Model::Peers2006));
        match way {
            0 => Options { model: Some(Model::Joint), ..base },
            1 => Options { model: tucker, degree: Some(terms), ..base },
            2 => Options { model: peers, ..base },
            3 => Options { model: peers, color_regression: true, degree: Some(1), ..base },
            4 => Options { backend: Some(Backend::Gram), ..base },
            5 => Options { backend: Some(Backend::Randomized), ..base },
            6 => Options::default(),
            7 => Options { model: tucker, ..Options::default() },
            _ => Options { goal: Goal::Psnr(20.0 * terms as f64), ..Options::default() },
        }
    };
    // Scaled variances are to be normal numbers, too.
    let scales = prop_oneof![(-95..=95_i32).prop_map(|k| (k, 0.0)), (-50..=50_i32).prop_map(|k| (k, 1e-3))];
    holds(20, (cases(), 0_usize..9, 1_usize..4, scales), |(case, way, terms, (exponent, variance))| {
        let mut matrix = Matrix::coloured(case).with_gaps(case.seed);
        matrix.rows.iter_mut().for_each(|r| r.variance.fill(variance));
        let scale = 2_f64.powi(exponent);
        let options = ways(way, terms);
        let (f, g) = (matrix.factored(&options), matrix.clone().scaled(scale).factored(&options));
        assert_eq!((f.rel_rmse, f.psnr_db), (g.rel_rmse, g.psnr_db), "{} / {}", f.choice, g.choice);
        let (a, b) = (&f.material.header, &g.material.header);
        assert_eq!((a.terms, a.degree, a.shared_maps, a.planes()), (b.terms, b.degree, b.shared_maps, b.planes()));
        assert_eq!((&f.material.shift, &a.warnings), (&g.material.shift, &b.warnings));
        let scaled = rows_of(&f.material).into_iter().flatten().map(|v| (f64::from(v) * scale) as f32);
        assert_eq!(scaled.collect::<Vec<_>>(), rows_of(&g.material).concat());
    });
}

fn measures(candidate: &Stored, reference: &Stored) -> Measures {
    let source = Source::Matrix(Box::new(MatrixReader::open(candidate.reader.path()).unwrap()));
    evaluate(&source, &reference.reader, &Progress::silent()).unwrap()
}

/// Another matrix of the same shape: every entry off by up to a fifth, others not measured, places off, some variance.
fn another(matrix: &Matrix, seed: u64) -> Matrix {
    let mut draw = Draw::new(seed ^ 12);
    let mut out = matrix.clone().with_gaps(seed ^ 13);
    for row in &mut out.rows {
        row.response.iter_mut().for_each(|v| *v *= 1.0 + 0.2 * draw.signed() as f32);
        row.variance.iter_mut().for_each(|v| *v = 0.01 * draw.unit() as f32);
    }
    out
}

#[test]
fn a_matrix_and_a_material_are_no_different_from_themselves() {
    holds(10, (cases(), 0..KINDS, -30..=30_i32), |(case, kind, decades)| {
        let matrix = Matrix::coloured(case).with_gaps(case.seed).scaled(10_f64.powi(decades));
        let stored = matrix.stored();
        let m = measures(&stored, &stored);
        let measured = matrix.rows.iter().flat_map(|r| &r.valid).filter(|v| **v).count();
        assert_eq!(m.entries, measured as u64);
        let zero = (matrix.energy() > 0.0).then_some(0.0);
        assert_eq!((m.rel_rmse, m.log_rmse, m.psnr_db, m.relit_psnr_db), (zero, zero, None, None));
        assert_eq!((m.position_rms_mm, m.coverage_2sigma), (0.0, None));
        // The rows of a material as a matrix: equal to the rounding of the f32 that it is stored as.
        let material = material(case, kind);
        let mut rows = Matrix::of(case.points, case.window, |_, _, _| 0.0);
        rows.header.pitch_mm = material.header.pitch_mm;
        rows.rows.iter_mut().zip(rows_of(&material)).for_each(|(row, values)| row.response = values);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.safetensors");
        material.save(&path).unwrap();
        let m = evaluate(&Source::open(&path).unwrap(), &rows.stored().reader, &Progress::silent()).unwrap();
        let sizes = (0..material.header.rows()).map(|i| formula(&material, i).1.powi(2)).sum::<f64>();
        let all = rows.energy();
        // A sum in another order may round to the neighbour, as far as it cancels not at all.
        let tolerance = 2.0 * F32 + 100.0 * F64 * (sizes * (3 * case.window[0] * case.window[1]) as f64 / all).sqrt();
        assert_eq!(m.rel_rmse.is_some(), all > 0.0);
        assert!(m.rel_rmse.is_none_or(|e| e <= tolerance), "{m:?}");
    });
}

#[test]
fn measures_do_not_change_with_a_common_scale_or_order_of_axes_and_channels() {
    holds(10, (cases(), changes(), -95..=95_i32), |(case, change, exponent)| {
        let reference = Matrix::coloured(case).with_gaps(case.seed);
        let candidate = another(&reference, case.seed);
        let m = measures(&candidate.stored(), &reference.stored());
        let scale = 2_f64.powi(exponent);
        let unvaried = |m: &Matrix| {
            let mut m = m.clone();
            m.rows.iter_mut().for_each(|r| r.variance.fill(0.0));
            m.scaled(scale)
        };
        let scaled = measures(&unvaried(&candidate).stored(), &unvaried(&reference).stored());
        // A power of two: not even rounding differs.
        let common = |m: &Measures| (m.entries, m.rel_rmse, m.psnr_db, m.log_rmse, m.relit_psnr_db, m.reciprocity);
        assert_eq!(common(&scaled), common(&m));
        assert_eq!(scaled.albedo_mean, m.albedo_mean.map(|a| a * scale));
        let changed = measures(&change.matrix(&candidate).stored(), &change.matrix(&reference).stored());
        assert_eq!((changed.entries, changed.albedo_violations), (m.entries, m.albedo_violations));
        let order = if let Change::Channels(order) = change { order } else { [0, 1, 2] };
        // Sums of up to 42 · 147 numbers in another order; decibels add 20 / ln 10 of a relative error.
        let tolerance = 1e4 * F64;
        for c in 0..3 {
            for (a, b) in [(changed.albedo_max, m.albedo_max), (changed.albedo_mean, m.albedo_mean)] {
                assert!((a[c] - b[order[c]]).abs() <= tolerance * b[order[c]].abs(), "{a:?} {b:?}");
            }
        }
        let pairs = [
            (changed.rel_rmse, m.rel_rmse),
            (changed.psnr_db, m.psnr_db),
            (changed.log_rmse, m.log_rmse),
            (changed.reciprocity, m.reciprocity),
            (changed.coverage_2sigma, m.coverage_2sigma),
        ];
        for (a, b) in pairs {
            assert_eq!(a.is_some(), b.is_some());
            let (a, b) = (a.unwrap_or(0.0), b.unwrap_or(0.0));
            assert!((a - b).abs() <= tolerance * b.abs().max(1.0), "{changed:?} {m:?}");
        }
    });
}

#[test]
fn a_known_error_is_measured_as_what_it_is() {
    holds(10, (cases(), -30..=30_i32, -5.0..1.0_f64), |(case, decades, digits)| {
        let mut draw = Draw::new(case.seed ^ 14);
        let reference = Matrix::coloured(case).scaled(10_f64.powi(decades));
        let asked = 10_f64.powf(digits);
        let noise: Vec<f64> = (0..reference.rows.len() * reference.header.row_len()).map(|_| draw.signed()).collect();
        let length = noise.iter().map(|v| v * v).sum::<f64>().sqrt();
        let step = asked * reference.energy().sqrt() / length;
        let mut candidate = reference.clone();
        let entries = candidate.rows.iter_mut().flat_map(|r| &mut r.response).zip(&noise);
        entries.for_each(|(v, n)| *v = (f64::from(*v) + step * n) as f32);
        let stored = reference.stored();
        let found = measures(&candidate.stored(), &stored).rel_rmse.unwrap();
        // The candidate is rounded to f32.
        assert!((found - asked).abs() <= F32 * (1.0 + asked), "{found} {asked}");
        let (factor, error) = [(0.0, 1.0), (2.0, 1.0), (-1.0, 2.0), (0.5, 0.5)][draw.below(4)];
        let found = measures(&reference.scaled(factor).stored(), &stored).rel_rmse;
        assert_eq!(found, Some(error), "times {factor}");
    });
}

/// Offsets of a window.
fn offsets(window: [usize; 2]) -> impl Iterator<Item = [isize; 2]> {
    let half = window.map(|w| (w / 2) as isize);
    (-half[1]..=half[1]).flat_map(move |y| (-half[0]..=half[0]).map(move |x| [x, y]))
}

#[test]
fn points_of_a_material_are_its_rows_however_they_are_asked_for() {
    holds(24, (cases(), 0..KINDS), |(case, kind)| {
        let mut m = material(case, kind);
        // A lattice, of which the evaluator knows where its points are.
        let [px, py] = m.header.lit_pitch_mm;
        m.lit_mm = (0..m.header.rows())
            .map(|i| [(i % case.points[0]) as f64 * px, (i / case.points[0]) as f64 * py])
            .collect();
        let evaluator = Evaluator::new(&m).unwrap();
        let block = source(&m).read(0..m.header.rows()).unwrap();
        for i in 0..m.header.rows() {
            let (expected, size) = formula(&m, i);
            let row = m.evaluate_row(i);
            for (k, d) in offsets(case.window).enumerate() {
                let x_i = m.lit_mm[i];
                let x_o = [0, 1].map(|a| x_i[a] + d[a] as f64 * m.header.pitch_mm);
                let all = [
                    [row[3 * k], row[3 * k + 1], row[3 * k + 2]],
                    [0, 1, 2].map(|c| block.view(i).response[3 * k + c]),
                    m.response(i, d).unwrap(),
                    evaluator.response(i, d).unwrap(),
                    evaluator.nearest(x_i, x_o),
                ];
                for (way, found) in all.into_iter().enumerate() {
                    for c in 0..3 {
                        // f64 sums of five terms, polynomials that lose (1 + √2)⁴ of it, then f32.
                        let tolerance = F32 * expected[k][c].abs() + 200.0 * F64 * size;
                        let off = (f64::from(found[c]) - expected[k][c]).abs();
                        assert!(off <= tolerance, "way {way}, row {i}, {d:?}: {found:?} {:?}", expected[k]);
                    }
                }
                // Places in mm are known to rounding of a lattice of up to 7 points; a neighbour's value is of the rows' size.
                let found = evaluator.between(x_i, x_o);
                let sizes = (0..m.header.rows()).map(|i| formula(&m, i).1).fold(0.0, f64::max);
                for c in 0..3 {
                    let off = (f64::from(found[c]) - expected[k][c]).abs();
                    let tolerance = F32 * expected[k][c].abs() + 1e4 * F64 * sizes;
                    assert!(off <= tolerance, "between, row {i}, {d:?}: {found:?} {:?}", expected[k]);
                }
            }
        }
    });
}

#[test]
fn draws_have_a_density_that_sums_to_one_and_is_that_of_the_draws() {
    holds(24, (cases(), 0..KINDS), |(case, kind)| {
        let m = material(case, kind);
        let evaluator = Evaluator::new(&m).unwrap();
        for i in 0..m.header.rows().min(4) {
            let probabilities: Vec<f64> = offsets(case.window).map(|d| evaluator.probability(i, d)).collect();
            let total: f64 = probabilities.iter().sum();
            const DRAWS: usize = 2000;
            let mut counts = vec![0; probabilities.len()];
            for k in 0..DRAWS {
                let Some(drawn) = evaluator.sample(i, (k as f64 + 0.5) / DRAWS as f64) else {
                    assert_eq!(total, 0.0, "nothing is modelled");
                    continue;
                };
                let at = offsets(case.window).position(|d| d == drawn.offset).expect("a draw in the window");
                assert_eq!(drawn.probability, probabilities[at]);
                counts[at] += 1;
            }
            if total == 0.0 {
                continue;
            }
            // Products of few f64 for each of up to 49 samples.
            assert!((total - 1.0).abs() <= 1e3 * F64, "row {i}: {total}");
            for (count, p) in counts.into_iter().zip(&probabilities) {
                // A sample has an interval of the uniform draws and one of the others; of evenly spaced ones each counts to within one.
                let off = (f64::from(count) / DRAWS as f64 - p).abs();
                assert!(off <= 2.0 / DRAWS as f64 + 1e3 * F64, "row {i}: {count} of {DRAWS}, {p}");
            }
        }
    });
}

fn array<T: npyz::Deserialize>(path: &Path, name: &str) -> Vec<T> {
    let mut zip = zip::ZipArchive::new(std::fs::File::open(path).unwrap()).unwrap();
    let Ok(mut file) = zip.by_name(&format!("{name}.npy")) else { return Vec::new() };
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).unwrap();
    npyz::NpyFile::new(bytes.as_slice()).unwrap().into_vec().unwrap()
}

#[test]
fn exported_arrays_make_the_same_rows() {
    holds(16, (cases(), 0..KINDS), |(case, kind)| {
        let m = material(case, kind);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.npz");
        export_npz(&m, &path).unwrap();
        let header: MaterialHeader = serde_json::from_slice(&array::<u8>(&path, "header_json")).unwrap();
        let back = Material {
            lit_mm: array::<f64>(&path, "lit_mm").as_chunks::<2>().0.to_vec(),
            weights: array(&path, "weights"),
            incident_factors: array(&path, "incident_factors"),
            offset_factors: array(&path, "offset_factors"),
            shared: header.shared_maps.map(|maps| SharedBasis {
                maps,
                vectors: array(&path, "offset_maps"),
                core: array(&path, "offset_core"),
            }),
            profile: array(&path, "profile"),
            color_coefficients: array(&path, "color_coefficients"),
            shift: array::<i16>(&path, "shift").as_chunks::<2>().0.to_vec(),
            header,
        };
        assert_eq!((bits(&back), &back), (bits(&m), &m));
        // Powers of the intensity give the colours that the polynomials do.
        let Some(degree) = m.header.degree else { return };
        let powers: Vec<f64> = array(&path, "color_monomials");
        let plain = Material { header: MaterialHeader { degree: None, ..m.header.clone() }, ..m.clone() };
        let [low, high] = m.header.intensity_range.map(f64::from);
        for i in 0..m.header.rows() {
            let ((values, _), (colours, size)) = (formula(&plain, i), formula(&m, i));
            for (value, colour) in values.iter().zip(&colours).filter(|(_, c)| **c != [0.0; 3]) {
                for c in 0..3 {
                    let at = (i * 3 + c) * (degree + 1);
                    let value = value[0].clamp(low, high);
                    let terms = (0..=degree).map(|p| powers[at + p] * value.powi(p as i32));
                    let (sum, sizes) = terms.fold((0.0, 0.0), |(s, a), t| (s + t, a + t.abs()));
                    // f64; powers of a degree of up to 4 over a range of 1 to 3 cancel to what the sum of their sizes shows.
                    let tolerance = 200.0 * F64 * (sizes + size);
                    assert!((sum - colour[c]).abs() <= tolerance, "{sum} {}", colour[c]);
                }
            }
        }
    });
}
