//! Random materials, and their rows by the formula.

use super::*;

/// A material of random numbers of size one. Kinds: all planes one's own or shared on either side, with a profile or
/// not, shared maps, polynomials.
pub(crate) fn material(case: Case, kind: usize) -> Material {
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
    let offset_factors = match shared {
        Some(shared) => OffsetFactors::Shared(shared),
        None => OffsetFactors::Own(draw.f32s(b * terms * samples)),
    };
    Material {
        entry_map: Vec::new(),
        exit_map: Vec::new(),
        header: MaterialHeader {
            exit_grid: None,
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
            warnings: vec![serde_json::json!({"kind": "empty_rows", "rows": draw.below(9)})],
            provenance: serde_json::json!({"seed": case.seed, "nested": {"number": draw.signed(), "none": null}}),
        },
        lit_mm: (0..n)
            .map(|i| [i % points[0], i / points[0]].map(|k| f64::from((k as f64 + 0.2 * draw.signed()) as f32)))
            .collect(),
        weights: draw.f32s(terms),
        incident_factors: draw.f32s(a * n * terms),
        offset_factors,
        profile: draw.f32s(if profile { b * samples } else { 0 }),
        color_coefficients: draw.f32s(degree.map_or(0, |p| n * 3 * (p + 1))),
        shift: (0..n).map(|_| window.map(|w| draw.below(w) as i16 - (w / 2) as i16)).collect(),
    }
}

pub(crate) const KINDS: usize = 8;

/// Row `i` by the formula of docs/materials.md, and what an error of each rounding may be relative to: Σ |g f h m|, and
/// where polynomials make colours of it Σ |β_p| (1 + p² · 2 Σ |g f h m| / (range)), as |dL_p/du| ≤ p².
pub(crate) fn formula(m: &Material, i: usize) -> (Vec<[f64; 3]>, f64) {
    let h = &m.header;
    let samples = h.extended[0] * h.extended[1];
    let factors = factors(m, samples);
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
                f64::from(m.weights[j]) * f64::from(f) * f64::from(factors[(b * h.terms + j) * samples + e]) * profile
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

/// All offset factors.
fn factors(m: &Material, samples: usize) -> Vec<f32> {
    match &m.offset_factors {
        OffsetFactors::Own(own) => own.clone(),
        OffsetFactors::Shared(s) => (0..s.core.len() / s.maps * samples)
            .map(|k| {
                let amount = |l: usize| f64::from(s.core[k / samples * s.maps + l]);
                (0..s.maps).map(|l| amount(l) * f64::from(s.vectors[l * samples + k % samples])).sum::<f64>() as f32
            })
            .collect(),
    }
}

pub(crate) fn source(material: &Material) -> Source {
    Source::Material(Box::new(material.clone()), "m".into())
}

/// All numbers of a material, as bits: zeros have signs.
pub(crate) fn bits(m: &Material) -> Vec<Vec<u32>> {
    m.tensors().map(|(_, _, values)| values.iter().map(|v| v.to_bits()).collect()).collect()
}
