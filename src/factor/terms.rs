//! The terms of a material: singular triplets of the rows, or a non-negative product.

use super::backend::Rows;
use super::backend::{self, Backend, LowRank, Triplets, low_rank, triplets};
use super::choose::{self, Goal};
use super::content::Content;
use super::fill::Basis;
use super::noise::F32_ROUNDING;
use super::nonnegative::factorize;
use super::prepared_rows::PreparedRows;
use super::shared_basis::Sharing;
use super::{FactorOptions, Misfit};
use crate::material::{Material, MaterialHeader, Model, OffsetFactors, Responses};
use crate::transport::MatrixReader;
use crate::words::count;
use crate::{Error, Result};
use rayon::prelude::*;

/// Singular values computed beyond those that may be used: the report's plot shows how they go on.
const BEYOND: usize = 5;
/// Singular values below this share of the largest do not estimate missing samples: back ends that multiply in f32 cannot tell them yet.
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
}

/// Factors rows into terms.
pub(super) fn fit(
    reader: &MatrixReader,
    rows: &mut PreparedRows<'_>,
    model: Model,
    options: &FactorOptions,
) -> Result<TermsFit> {
    let (n, columns) = rows.shape();
    let chosen = options.backend.unwrap_or_else(|| backend::choose(n, columns, options.accuracy));
    let mut most = options.terms.unwrap_or(options.max_terms);
    let mut start = None;
    loop {
        // A non-negative product is fitted to a projection that holds much more than it can.
        let wanted = if model == Model::Peers2006 { 3 * most + 20 } else { most + BEYOND };
        let low = decompose(rows, options, chosen, wanted, start.take())?;
        let exact = matches!(chosen, Backend::Full | Backend::Gram);
        let all = triplets(rows, &low, wanted, exact)?;
        let rank = all.weights.iter().take_while(|&&s| s > F32_ROUNDING * all.weights[0] && s > 0.0).count().max(1);
        let rank = if model == Model::Peers2006 { rank.max(most) } else { rank };
        let asked = Asked { rank, most, rows, model, options };
        let plan = asked.plan(reader, &all)?;
        let enough = !plan.short || rank < most || most >= 4 * options.max_terms || most >= n.min(columns);
        if enough {
            let how = format!(
                "{chosen}, {}{}{}",
                count(low.passes, "pass"),
                if low.residual > 0.0 { format!(", singular values to {:.0e}", low.residual) } else { String::new() },
                if rows.in_memory() { "" } else { ", streamed from the store" },
            );
            return asked.finish(reader, &all, plan, chosen, how);
        }
        most *= 2;
        start = Some(low);
    }
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
            options.terms.unwrap_or_else(|| rows.survey.noise.terms(&low.singular_values)).min(options.max_terms);
        let noise = rows.survey.noise.mean;
        rows.refill(Basis::factors(&low, terms.min(most), n, columns, noise));
        start = Some(low);
    }
    Err(Error::internal("the factorization ended without a result"))
}

/// What is known when terms are chosen.
struct Asked<'r, 'a> {
    /// Terms that the rows have.
    rank: usize,
    /// Terms that were looked for.
    most: usize,
    rows: &'r PreparedRows<'a>,
    model: Model,
    options: &'r FactorOptions,
}

/// What was chosen.
struct Plan {
    terms: usize,
    /// Maps that the channels share; `None`: as many as make no difference.
    maps: Option<usize>,
    degree: Option<usize>,
    why: String,
    /// Whether the goal would have more terms.
    short: bool,
}

impl Asked<'_, '_> {
    fn plan(&self, reader: &MatrixReader, all: &Triplets) -> Result<Plan> {
        let (options, noise) = (self.options, &self.rows.survey.noise);
        let most = self.rank.min(self.most);
        if let Some(asked) = options.terms {
            let why = match asked > self.rank {
                true => format!("{asked} asked, all that the rows have"),
                false => "as asked".to_owned(),
            };
            return Ok(Plan { terms: asked.min(self.rank), maps: None, degree: None, why, short: false });
        }
        match options.goal {
            Goal::Noise => {
                let terms = noise.terms(&all.weights).min(most);
                let level = noise.threshold(&all.weights);
                let why = match all.weights.get(terms) {
                    Some(&next) if next > level => format!(
                        "the most allowed, singular values {} … are still above the noise ({next:.3e} > {level:.3e})",
                        terms + 1
                    ),
                    Some(&next) => {
                        format!("singular values {} … are below the noise ({next:.3e} < {level:.3e})", terms + 1)
                    }
                    None => format!("all that the rows have, noise {level:.3e}"),
                };
                Ok(Plan { terms, maps: None, degree: None, why, short: false })
            }
            goal if self.rows.content == Content::Intensity => {
                let material = self.material(reader, all, most);
                let chosen = choose::terms_and_degree(reader, &material, &self.rows.survey, goal, options)?;
                let short = chosen.terms >= most && chosen.short;
                Ok(Plan { terms: chosen.terms, maps: None, degree: Some(chosen.degree), why: chosen.why, short })
            }
            goal => self.plan_for(reader, goal, all, most),
        }
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
        let mut header = self.header(reader, all);
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
        Ok(Plan { terms, maps: maps.or(Some(planes * terms)), degree: None, why, short })
    }

    /// The header of a material of one term, without a colour polynomial.
    fn header(&self, reader: &MatrixReader, all: &Triplets) -> MaterialHeader {
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
            degree: None,
            intensity_range: [0.0, 1.0],
            singular_values: all.weights.iter().map(|g| g * unit).collect(),
            noise_level: survey.noise.threshold(&all.weights) * unit,
            warnings: Vec::new(),
            provenance: serde_json::Value::Null,
        }
    }

    /// The first `terms` triplets as a material.
    fn material(&self, reader: &MatrixReader, all: &Triplets, terms: usize) -> Material {
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
            header: MaterialHeader { terms, ..self.header(reader, all) },
            lit_mm: reader.header().lit_mm.clone(),
            weights,
            incident_factors: left,
            offset_factors: right.into(),
            profile: Vec::new(),
            color_coefficients: Vec::new(),
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
                None => sharing.unnoticed(terms, self.left(all, terms))?,
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
        let mut material = self.material(reader, all, 1);
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

    fn finish(
        &self,
        reader: &MatrixReader,
        all: &Triplets,
        plan: Plan,
        backend: Backend,
        how: String,
    ) -> Result<TermsFit> {
        let Plan { terms, maps, degree, why, .. } = plan;
        let material = match self.model {
            Model::Peers2006 => self.non_negative(reader, all, terms),
            _ => self.shared(self.material(reader, all, terms), all, maps)?,
        };
        let error = if self.rows.content == Content::Intensity { 0.0 } else { self.residual(reader, &material)? };
        let misfit = self.rows.survey.misfit(error);
        Ok(TermsFit { material, why, how, backend, misfit, degree })
    }

    /// Σ (R̂−R)² over the valid entries of the matrix, of a material without a colour polynomial.
    fn residual(&self, reader: &MatrixReader, material: &Material) -> Result<f64> {
        if self.rows.content == Content::Grey {
            return residual_of_rows(reader, material);
        }
        let (planes, columns) = (self.rows.content.planes(), self.rows.shape().1);
        let samples = columns / planes;
        let unit = self.rows.unit();
        let (mut error, responses) = (0.0, Responses::new(material));
        self.rows.for_each_chunk("measure", &mut |first, values, missing| {
            let indices: Vec<usize> = (first..first + missing.len()).collect();
            let fits: Vec<Vec<f64>> = (0..planes).map(|p| responses.plane(p, &indices)).collect();
            let errors: Vec<f64> = missing
                .par_iter()
                .enumerate()
                .map(|(k, gaps)| {
                    let row = &values[k * columns..(k + 1) * columns];
                    let mut sum = 0.0;
                    let mut gaps = self.rows.missing(gaps).iter().peekable();
                    for p in 0..planes {
                        for (e, fit) in fits[p][k * samples..(k + 1) * samples].iter().enumerate() {
                            let column = p * samples + e;
                            if gaps.peek() == Some(&&(column as u32)) {
                                gaps.next();
                                continue;
                            }
                            sum += (fit / unit - f64::from(row[column])).powi(2);
                        }
                    }
                    sum
                })
                .collect();
            error += errors.iter().sum::<f64>();
            Ok(())
        })?;
        Ok(error * unit * unit)
    }
}

/// The same for any material, by evaluating it: one pass over the store.
fn residual_of_rows(reader: &MatrixReader, material: &Material) -> Result<f64> {
    let (mut error, responses) = (0.0, Responses::new(material));
    for range in reader.blocks() {
        let block = reader.read_responses(range)?;
        let errors: Vec<f64> = (0..block.rows)
            .into_par_iter()
            .map(|k| {
                let (fit, row) = (responses.row(block.first + k), block.view(k));
                let entries = fit.iter().zip(row.response).zip(row.valid).filter(|(_, v)| **v != 0);
                entries.map(|((&a, &b), _)| (f64::from(a) - f64::from(b)).powi(2)).sum()
            })
            .collect();
        error += errors.iter().sum::<f64>();
    }
    Ok(error)
}

#[cfg(test)]
mod tests;
