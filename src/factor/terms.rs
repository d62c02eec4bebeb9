//! The terms of a material: singular triplets of the rows, or a non-negative product.

use super::backend::Rows;
use super::backend::{Backend, LowRank, Triplets, low_rank, triplets};
use super::choose::{self, Goal};
use super::content::Content;
use super::entry_exit::{Marginals, ROUNDS, ROUNDS_BETWEEN};
use super::fill::Basis;
use super::noise::{F32_ROUNDING, TermNoise, significant};
use super::nonnegative::factorize;
use super::prepared_rows::PreparedRows;
use super::shared_basis::Sharing;
use super::tasks::Pass;
use super::{FactorOptions, Misfit, TermLevel};
use crate::material::{Material, MaterialHeader, Model, OffsetFactors, Responses};
use crate::transport::MatrixReader;
use crate::words::{count, plain};
use crate::{Error, Result};
use rayon::prelude::*;
use std::ops::Range;

/// Singular values computed beyond those that may be used: the report's plot shows how they go on.
const BEYOND: usize = 5;
/// Singular values below this share of the largest do not estimate missing samples: back ends that multiply in f32
/// cannot tell them yet.
const FILL_ABOVE: f64 = 1e-3;

/// What singular values may be off by while missing samples are estimated.
const FILL_ACCURACY: f64 = 1e-4;

/// A material without its colour polynomial, and why it is as it is.
pub(super) struct TermsFit {
    pub material: Material,
    pub why: String,
    pub how: String,
    pub backend: Backend,
    /// What is left, when there is no colour polynomial to come.
    pub misfit: Misfit,
    /// The degree that the goal asks for.
    pub degree: Option<usize>,
    pub levels: Vec<TermLevel>,
}

/// Times that terms are fitted anew to what entry and exit maps leave.
///
/// `rel_rmse` of the chessboard and of marble falls by 6 to 20 % with the first, 3 to 15 % with the second, 2 to 8 %
/// with the third (docs/materials.md); each costs a decomposition.
const REFITS: usize = 2;

/// Maps that make `rel_rmse` so many times larger are not kept: three times what they cost at the same terms on the
/// materials of docs/materials.md.
const WORSE: f64 = 4.0;

/// A decomposition of the rows.
struct Found {
    /// Terms in the unit of the rows: left vectors are orthonormal, right ones of length one.
    all: Triplets,
    /// Singular values of the rows as they were weighed.
    singular: Vec<f64>,
    noise: Vec<TermNoise>,
}

impl Found {
    fn new(rows: &PreparedRows<'_>, low: &LowRank, wanted: usize, exact: bool) -> Result<Self> {
        let mut all = triplets(rows, low, wanted, exact)?;
        let noise = rows.noise.of_terms(&all, &rows.metric, rows.survey.layout.extended);
        let singular = all.weights.clone();
        if !rows.metric.is_empty() {
            let columns = rows.metric.len();
            for (h, g) in all.right.chunks_exact_mut(columns).zip(&mut all.weights) {
                h.iter_mut().zip(&rows.metric).for_each(|(v, &w)| *v /= f64::from(w));
                let length = h.iter().map(|v| v * v).sum::<f64>().sqrt();
                if length > 0.0 {
                    h.iter_mut().for_each(|v| *v /= length);
                    *g *= length;
                }
            }
        }
        Ok(Self { all, singular, noise })
    }

    /// Terms that differ from rounding.
    fn rank(&self) -> usize {
        let largest = self.singular.first().copied().unwrap_or(0.0);
        self.singular.iter().take_while(|&&s| s > F32_ROUNDING * largest && s > 0.0).count().max(1)
    }

    /// The terms at `kept` alone; what noise adds to them taken off where `shrink` says so.
    fn chosen(&self, kept: &[usize], shrink: bool) -> Triplets {
        let (terms, all) = (self.all.weights.len(), &self.all);
        let (n, columns) = (all.left.len() / terms.max(1), all.right.len() / terms.max(1));
        let share = |j: usize| if shrink { self.noise[j].kept(self.singular[j]) } else { 1.0 };
        Triplets {
            weights: kept.iter().map(|&j| all.weights[j] * share(j)).collect(),
            left: (0..n).flat_map(|i| kept.iter().map(move |&j| all.left[i * terms + j])).collect(),
            right: kept.iter().flat_map(|&j| &all.right[j * columns..][..columns]).copied().collect(),
        }
    }
}

/// Factors rows into terms; `sums` are what entry and exit maps are fitted to, where there may be any.
pub(super) fn fit(
    reader: &MatrixReader,
    rows: &mut PreparedRows<'_>,
    model: Model,
    options: &FactorOptions,
    sums: Option<&Marginals>,
) -> Result<TermsFit> {
    let (n, columns) = rows.shape();
    let chosen = options.backend.map_or_else(|| rows.choose_backend(options.accuracy), Ok)?;
    let exact = matches!(chosen, Backend::Full | Backend::Gram);
    let mut most = options.terms.unwrap_or(options.max_terms);
    let mut start = None;
    let (found, plan, low) = loop {
        // A non-negative product is fitted to a projection that holds much more than it can.
        let wanted = if model == Model::Peers2006 { 3 * most + 20 } else { most + BEYOND };
        let low = decompose(rows, options, chosen, wanted, start.take())?;
        let found = Found::new(rows, &low, wanted, exact)?;
        let rank = if model == Model::Peers2006 { found.rank().max(most) } else { found.rank() };
        let plan = Asked { rows, model, options, sums }.plan(reader, &found, rank, most)?;
        if !plan.short || rank < most || most >= 4 * options.max_terms || most >= n.min(columns) {
            break (found, plan, low);
        }
        most *= 2;
        start = Some(low);
    };
    let (mut passes, residual) = (low.passes, low.residual);
    let mut material = Asked { rows, model, options, sums }.made(reader, &found, &plan)?;
    // Of an intensity the colour polynomial is still to come.
    let mut left = if rows.content == Content::Intensity { 0.0 } else { residual_of(rows, reader, &material)? };
    let levels = Asked { rows, model, options, sums }.levels(&found, &plan);
    let mut why = plan.why.clone();
    let maps = match (sums, options.maps) {
        (Some(sums), Some(true)) => Some(sums),
        // Only what the scene requires.
        (Some(sums), _) if sums.differ(&material)? => Some(sums),
        _ => None,
    };
    if let Some(sums) = maps {
        let (planes, refits) = (rows.content.planes(), if model == Model::Joint { REFITS } else { 0 });
        let rounds = |refit: usize| if refit == refits { ROUNDS } else { ROUNDS_BETWEEN };
        let mut with = material.clone();
        sums.fit(&mut with, planes, rounds(0))?;
        let mut start = Some(low);
        for refit in 1..=refits {
            rows.divide_by(&with);
            let wanted = plan.most() + BEYOND;
            let low = decompose(rows, options, chosen, wanted, start.take())?;
            passes += low.passes;
            let found = Found::new(rows, &low, wanted, exact)?;
            start = Some(low);
            let terms = Asked { rows, model, options, sums: Some(sums) }.made(reader, &found, &plan)?;
            with = with_maps_of(terms, with);
            sums.fit(&mut with, planes, rounds(refit))?;
        }
        let error = residual_of(rows, reader, &with)?;
        // Maps that take more from the rows than they give: sums that are not those of anything like light.
        if options.maps.is_none() && error > WORSE * WORSE * left {
            why += "; entry and exit maps would fit the rows worse";
        } else {
            (material, left) = (with, error);
        }
    }
    let how = format!(
        "{chosen}, {}{}{}",
        count(passes, "pass"),
        if residual > 0.0 { format!(", singular values to {residual:.0e}") } else { String::new() },
        rows.how_read(),
    );
    let misfit = rows.survey.misfit(left);
    Ok(TermsFit { material, why, how, backend: chosen, misfit, degree: plan.degree, levels })
}

/// `terms` with the entry and exit maps of `maps`.
fn with_maps_of(mut terms: Material, maps: Material) -> Material {
    terms.header.exit_grid = maps.header.exit_grid;
    Material { entry_map: maps.entry_map, exit_map: maps.exit_map, ..terms }
}

/// The truncated SVD of the rows, repeated while missing samples are estimated from it.
fn decompose(
    rows: &mut PreparedRows<'_>,
    options: &FactorOptions,
    backend: Backend,
    wanted: usize,
    mut start: Option<LowRank>,
) -> Result<LowRank> {
    let (n, columns) = rows.shape();
    let rounds = if rows.has_gaps() { options.fill_rounds } else { 0 };
    let mut passes = 0;
    for round in 0..=rounds {
        // What fills gaps for a first time need not be known well.
        let accuracy = if round + 1 >= rounds { options.accuracy } else { options.accuracy.max(FILL_ACCURACY) };
        let mut low = low_rank(rows, wanted, backend, accuracy, start.as_ref())?;
        passes += low.passes;
        low.passes = passes;
        if round == rounds {
            return Ok(low);
        }
        let largest = low.singular_values.first().copied().unwrap_or(0.0);
        let visible = low.singular_values.iter().take_while(|&&s| s > FILL_ABOVE * largest).count().max(1);
        let most = if matches!(backend, Backend::Full | Backend::Gram) {
            low.singular_values.iter().take_while(|&&s| s > F32_ROUNDING * largest).count().max(1)
        } else {
            visible
        };
        let terms =
            options.terms.unwrap_or_else(|| rows.noise.count_above(&low.singular_values)).min(options.max_terms);
        let noise = rows.noise.mean;
        rows.refill(Basis::factors(&low, terms.min(most), n, columns, noise));
        start = Some(low);
    }
    Err(Error::internal("the factorization ended without a result"))
}

/// What is known when terms are chosen.
struct Asked<'r, 'a> {
    rows: &'r PreparedRows<'a>,
    model: Model,
    options: &'r FactorOptions,
    sums: Option<&'r Marginals>,
}

/// What was chosen.
struct Plan {
    /// The terms, of those found.
    kept: Kept,
    /// Maps that the channels share; `None`: as many as make no difference.
    maps: Option<usize>,
    degree: Option<usize>,
    why: String,
    /// Whether the goal would have more terms.
    short: bool,
}

/// Which of the terms that were found are kept.
#[derive(Debug, Clone, Copy)]
enum Kept {
    /// The first.
    First(usize),
    /// Those above their noise, at most so many; what noise adds to them is taken off.
    AboveNoise(usize),
}

impl Plan {
    /// The most terms that it keeps.
    fn most(&self) -> usize {
        let (Kept::First(n) | Kept::AboveNoise(n)) = self.kept;
        n
    }

    /// Their numbers among those found.
    fn kept(&self, found: &Found) -> Vec<usize> {
        match self.kept {
            Kept::First(n) => (0..n.min(found.singular.len())).collect(),
            Kept::AboveNoise(most) => significant(&found.singular, &found.noise, most),
        }
    }
}

impl Asked<'_, '_> {
    /// What to keep of `found`, where the rows have `rank` terms and `looked_for` were looked for.
    fn plan(&self, reader: &MatrixReader, found: &Found, rank: usize, looked_for: usize) -> Result<Plan> {
        let (options, all) = (self.options, &found.all);
        let most = rank.min(looked_for);
        let plan = |kept, why| Plan { kept, maps: None, degree: None, why, short: false };
        if let Some(asked) = options.terms {
            let why = match asked > rank {
                true => format!("{asked} asked, all that the rows have"),
                false => "as asked".to_owned(),
            };
            return Ok(plan(Kept::First(asked.min(rank)), why));
        }
        match options.goal {
            Goal::Noise => {
                let kept = significant(&found.singular, &found.noise, most);
                let next = (0..found.singular.len()).find(|j| !kept.contains(j));
                let unit = self.rows.unit();
                let why = match next.map(|j| (j + 1, found.singular[j] * unit, found.noise[j].level() * unit)) {
                    Some((j, s, level)) if s > level => format!(
                        "the most allowed, more singular values are above their noise (number {j}: {} > {}, …)",
                        plain(s, 3),
                        plain(level, 3)
                    ),
                    Some((j, s, level)) => format!(
                        "other singular values are below their noise (number {j}: {} < {})",
                        plain(s, 3),
                        plain(level, 3)
                    ),
                    None => "all that the rows have".to_owned(),
                };
                Ok(plan(Kept::AboveNoise(most), why))
            }
            goal if self.rows.content == Content::Intensity => {
                let material = self.material(reader, all, most, &found.singular);
                let chosen = choose::terms_and_degree(reader, &material, &self.rows.survey, goal, options)?;
                let short = chosen.terms >= most && chosen.short;
                let kept = Kept::First(chosen.terms);
                Ok(Plan { kept, maps: None, degree: Some(chosen.degree), why: chosen.why, short })
            }
            goal => self.plan_for(reader, goal, all, most),
        }
    }

    /// The singular values that were found beside their noise, in the unit of the header's.
    fn levels(&self, found: &Found, plan: &Plan) -> Vec<TermLevel> {
        let (kept, unit) = (plan.kept(found), self.rows.unit());
        let terms = found.singular.iter().zip(&found.noise).enumerate();
        let level = |(j, (s, n)): (usize, (&f64, &TermNoise))| TermLevel {
            singular_value: s * unit,
            noise: n.level() * unit,
            kept: kept.contains(&j),
        };
        if self.model == Model::Peers2006 { Vec::new() } else { terms.map(level).collect() }
    }

    /// Σ of squares of the rows as they are factored, in their unit, as far as they were measured.
    fn energy(&self) -> f64 {
        self.rows.survey.energy / self.rows.content.channels_per_plane() / self.rows.unit().powi(2)
    }

    /// What the first `terms` leave of it.
    fn left(&self, all: &Triplets, terms: usize) -> f64 {
        (self.energy() - all.weights.iter().take(terms).map(|s| s * s).sum::<f64>()).max(0.0)
    }

    /// Terms, and the maps that channels share, for a goal: every number of terms with the best number of maps.
    fn plan_for(&self, reader: &MatrixReader, goal: Goal, all: &Triplets, most: usize) -> Result<Plan> {
        let (survey, planes) = (&self.rows.survey, self.rows.content.planes());
        let scale = self.rows.content.channels_per_plane() * self.rows.unit().powi(2);
        let psnr = |left: f64| survey.misfit(scale * left).psnr_db().unwrap_or(f64::INFINITY);
        let non_negative = self.model == Model::Peers2006;
        let shifted = survey.placements.iter().any(|p| p.shift != [0, 0]);
        let mut header = self.header(reader, &[]);
        if let Some(sums) = self.sums {
            header.exit_grid = Some(sums.grid(planes));
        }
        if non_negative {
            (header.incident_planes, header.profile) = (planes, true);
        }
        let mut bytes = |terms, maps| {
            (header.terms, header.shared_maps) = (terms, maps);
            header.bytes_f32(shifted)
        };
        // A non-negative product may have more terms than the rows have triplets.
        let sharing = Sharing::new(all, planes, most.min(all.weights.len()));
        let mut candidates = Vec::new();
        for terms in 1..=most {
            candidates.push((terms, None, bytes(terms, None), psnr(self.left(all, terms))));
            if planes == 1 || non_negative {
                continue;
            }
            let left_out = sharing.left_out(terms)?;
            for (maps, left) in left_out.iter().enumerate().skip(1) {
                candidates.push((terms, Some(maps), bytes(terms, Some(maps)), psnr(self.left(all, terms) + left)));
            }
        }
        let (found, why) = match goal {
            Goal::Psnr(db) => match candidates.iter().filter(|c| c.3 >= db).min_by_key(|c| c.2) {
                Some(found) => (found, format!("the fewest bytes that reach {db} dB")),
                None => {
                    let best = candidates.iter().max_by(|a, b| a.3.total_cmp(&b.3));
                    (best.unwrap_or(&candidates[0]), format!("the most possible, {db} dB not reached"))
                }
            },
            Goal::Bytes(bytes) => match candidates.iter().filter(|c| c.2 <= bytes).max_by(|a, b| a.3.total_cmp(&b.3)) {
                Some(found) => (found, format!("the best in {bytes} bytes")),
                None => {
                    let smallest = candidates.iter().min_by_key(|c| c.2).unwrap_or(&candidates[0]);
                    (smallest, format!("the smallest takes more than {bytes} bytes"))
                }
            },
            Goal::Noise => (&candidates[0], String::new()),
        };
        let &(terms, maps, ..) = found;
        let short = terms == most;
        Ok(Plan { kept: Kept::First(terms), maps: maps.or(Some(planes * terms)), degree: None, why, short })
    }

    /// The header of a material of one term, without a colour polynomial.
    fn header(&self, reader: &MatrixReader, singular: &[f64]) -> MaterialHeader {
        let (header, survey, unit) = (reader.header(), &self.rows.survey, self.rows.unit());
        MaterialHeader {
            model: self.model,
            points: header.points,
            window: header.window,
            pitch_mm: header.pitch_mm,
            lit_pitch_mm: header.lit_pitch_mm,
            extended: survey.layout.extended,
            terms: 1,
            incident_planes: 1,
            offset_planes: self.rows.content.planes(),
            shared_maps: None,
            profile: false,
            exit_grid: None,
            degree: None,
            intensity_range: [0.0, 1.0],
            singular_values: singular.iter().map(|g| g * unit).collect(),
            noise_level: self.rows.noise.bound(singular) * unit,
            warnings: Vec::new(),
            provenance: serde_json::Value::Null,
        }
    }

    /// The first `terms` triplets as a material.
    fn material(&self, reader: &MatrixReader, all: &Triplets, terms: usize, singular: &[f64]) -> Material {
        let planes = self.rows.content.planes();
        let ((n, columns), rank) = (self.rows.shape(), all.weights.len());
        let terms = terms.min(rank);
        let unit = self.rows.unit();
        let left: Vec<f32> =
            (0..n).flat_map(|i| all.left[i * rank..i * rank + terms].iter().map(|&v| v as f32)).collect();
        let samples = columns / planes;
        let plane = |p: usize| {
            (0..terms).flat_map(move |j| &all.right[j * columns + p * samples..j * columns + (p + 1) * samples])
        };
        let right: Vec<f32> = (0..planes).flat_map(plane).map(|&v| v as f32).collect();
        let weights = all.weights[..terms].iter().map(|&g| (g * unit) as f32).collect();
        Material {
            header: MaterialHeader { terms, ..self.header(reader, singular) },
            lit_mm: reader.header().lit_mm.clone(),
            weights,
            incident_factors: left,
            offset_factors: right.into(),
            profile: Vec::new(),
            color_coefficients: Vec::new(),
            entry_map: Vec::new(),
            exit_map: Vec::new(),
            shift: self.rows.survey.placements.iter().map(|p| p.shift).collect(),
        }
    }

    /// The same with offset factors as sums of fewer maps, where that takes fewer numbers.
    fn shared(&self, mut material: Material, all: &Triplets, maps: Option<usize>) -> Result<Material> {
        let (terms, planes) = (material.header.terms, self.rows.content.planes());
        if planes > 1 {
            let sharing = Sharing::new(all, planes, terms);
            let maps = match maps {
                Some(maps) => maps,
                None => sharing.unnoticed(terms, self.rows.misfit(&material, true)?)?,
            };
            if let Some(shared) = sharing.basis(terms, maps)? {
                material.header.shared_maps = Some(shared.maps);
                material.offset_factors = OffsetFactors::Shared(shared);
            }
        }
        Ok(material)
    }

    /// The mean profile and non-negative factors for each plane.
    fn non_negative(&self, reader: &MatrixReader, all: &Triplets, terms: usize) -> Material {
        let mut material = self.material(reader, all, 1, &[]);
        let (planes, columns) = (self.rows.content.planes(), self.rows.shape().1);
        let samples = columns / planes;
        let unit = self.rows.unit();
        let h = &mut material.header;
        (h.terms, h.incident_planes, h.offset_planes, h.profile) = (terms, planes, planes, true);
        h.singular_values.clear();
        material.weights = vec![1.0; terms];
        material.incident_factors = Vec::new();
        let mut offset_factors = Vec::new();
        for p in 0..planes {
            let profile: Vec<f64> =
                self.rows.survey.mean[p * samples..(p + 1) * samples].iter().map(|&m| m.max(0.0)).collect();
            let found = factorize(all, columns, p * samples, &profile, terms);
            material.incident_factors.extend(found.left.iter().map(|&v| v as f32));
            offset_factors.extend(found.right.iter().map(|&v| v as f32));
            material.profile.extend(profile.iter().map(|&m| (m * unit) as f32));
        }
        material.offset_factors = offset_factors.into();
        material
    }

    /// The material of what the plan keeps.
    fn made(&self, reader: &MatrixReader, found: &Found, plan: &Plan) -> Result<Material> {
        let (kept, shrink) = (plan.kept(found), matches!(plan.kept, Kept::AboveNoise(_)));
        if self.model == Model::Peers2006 {
            return Ok(self.non_negative(reader, &found.all, plan.most()));
        }
        // The mean profile is never nothing, however noisy.
        let all = found.chosen(&kept, shrink && kept.len() > 1);
        self.shared(self.material(reader, &all, kept.len(), &found.singular), &all, plan.maps)
    }
}

/// Σ (R̂−R)² over the valid entries of the matrix, of a material without a colour polynomial.
fn residual_of(rows: &PreparedRows<'_>, reader: &MatrixReader, material: &Material) -> Result<f64> {
    match (rows.content, rows.tasks()) {
        (Content::Channels, _) => Ok(rows.misfit(material, false)? * rows.unit().powi(2)),
        (_, Some(tasks)) => tasks.sum(Pass::Residual { material: material.into() }),
        (_, None) => residual_of_rows(reader, material, 0..reader.header().rows()),
    }
}

/// The same of some rows for any material, by evaluating it: one pass over the store.
pub(super) fn residual_of_rows(reader: &MatrixReader, material: &Material, rows: Range<usize>) -> Result<f64> {
    let (mut error, responses) = (0.0, Responses::new(material));
    reader.for_each_block_of(rows, false, |block| {
        let errors: Vec<f64> = (0..block.rows)
            .into_par_iter()
            .map(|k| {
                let (fit, row) = (responses.row(block.first + k), block.view(k));
                let entries = fit.iter().zip(row.response).zip(row.valid).filter(|(_, v)| **v != 0);
                entries.map(|((&a, &b), _)| (f64::from(a) - f64::from(b)).powi(2)).sum()
            })
            .collect();
        error += errors.iter().sum::<f64>();
        Ok(())
    })?;
    Ok(error)
}

#[cfg(test)]
mod tests;
