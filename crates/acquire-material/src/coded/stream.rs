//! The two streams of a coded material: the header's text, and everything that is a number.

use super::entropy::{Bits, Reader, Writer};
use super::exact::{positions, raw, shifts, weights};
use super::falloff::Falloff;
use super::maps::{Group, Price, step_index};
use super::measure::{energy, refit_weights, slope, stride};
use super::planes::{ColorBasis, Rotation, moments};
use super::text::code_text;
use super::through::{EvenLight, read_through, write_through};
use crate::parallel::*;
use crate::{CHANNELS, Material, MaterialHeader, Responses, offset_plane};

/// No stored number is larger.
const LARGEST: f64 = 1e30;
/// The profile is kept this many times finer than the maps: the terms are divided by it.
const PROFILE_FINER: f64 = 4.0;
/// Where the profile is below this part of its largest value, the terms are zero.
const LEAST_PROFILE: f64 = 1e-6;
/// Step numbers are stored as 16 bits above this one.
const LOWEST_STEP: i32 = -(1 << 15);
/// More numbers than a bit can hold: the likeliest bit has a probability of 65514/65536.
const MOST_PER_BIT: u128 = 2100;

pub(super) fn write_header(text: &str) -> Result<Vec<u8>, String> {
    let mut writer = Writer::default();
    code_text(&mut writer, Some(text))?;
    Ok(writer.finish())
}

pub(super) fn read_header(bytes: &[u8]) -> Result<String, String> {
    code_text(&mut Reader::new(bytes)?, None)
}

/// Which tensors have no negative entry: their decoded values have none either.
#[derive(Clone, Copy)]
struct NonNegative {
    incident: bool,
    offset: bool,
    profile: bool,
}

impl NonNegative {
    fn code<B: Bits>(self, bits: &mut B) -> Result<Self, String> {
        let mut flag = |f: bool| bits.code(f, 1 << 15);
        Ok(Self { incident: flag(self.incident)?, offset: flag(self.offset)?, profile: flag(self.profile)? })
    }
}

/// What the decoder knows of the maps when it reaches the offset factors.
struct Scales<'a> {
    weights: &'a [f32],
    /// \[B\]\[samples\], or empty.
    profile: &'a [Vec<f64>],
    /// What maps are divided by, by sample.
    falloff: &'a [f64],
}

impl Scales<'_> {
    /// Zeroes what cannot be divided by weight and profile, and negative numbers when there must be none.
    fn clean(&self, term: usize, plane: usize, map: &mut [f64], clip: bool) {
        let nothing = self.weights[term] == 0.0;
        let negative = self.weights[term] < 0.0;
        let profile = self.profile.get(plane);
        let least = profile.map_or(0.0, |m| LEAST_PROFILE * m.iter().fold(0.0, |a: f64, v| a.max(v.abs())));
        for (e, v) in map.iter_mut().enumerate() {
            let m = profile.map_or(1.0, |m| m[e]);
            let clipped = clip && (*v < 0.0) != (negative != (m < 0.0));
            if nothing || m == 0.0 || m.abs() < least || clipped {
                *v = 0.0;
            }
        }
    }

    /// h from g·m·h over the falloff.
    fn unscaled(&self, term: usize, plane: usize, map: &[f64]) -> Vec<f64> {
        let g = f64::from(self.weights[term]);
        let profile = self.profile.get(plane);
        let one = |(e, v): (usize, &f64)| match *v {
            0.0 => 0.0,
            v => v * self.falloff[e] / (g * profile.map_or(1.0, |m| m[e])),
        };
        map.iter().enumerate().map(one).collect()
    }
}

/// Everything but the header; `norm` is ‖R̂‖. Entry and exit maps are fitted again to `even`.
pub(super) fn write_maps(
    material: &Material,
    even: Option<&EvenLight>,
    norm: f64,
    price: Price,
    position_error_px: f64,
) -> Result<Vec<u8>, String> {
    let h = &material.header;
    let mut w = Writer::default();
    let singular: Vec<f64> = h.singular_values.iter().map(|&v| f64::from(v as f32)).collect();
    weights(&mut w, &material.weights, &singular, h.terms)?;
    shifts(&mut w, &material.shift, h.points)?;
    let lit_mm = positions(&mut w, &material.lit_mm, h.points, 2.0 * position_error_px * h.pitch_mm)?;
    let no_negative = |values: &[f32]| values.iter().all(|v| *v >= 0.0);
    let non_negative = NonNegative {
        incident: no_negative(&material.incident_factors),
        offset: no_negative(&material.offset_factors.all()),
        profile: no_negative(&material.profile),
    };
    non_negative.code(&mut w)?;
    let first = step_index(price.step);
    raw(&mut w, (first - LOWEST_STEP) as u64, 16)?;
    let slope = slope(material);
    let profile = write_profile(&mut w, material, slope, price, first, non_negative.profile)?;
    let falloff = Falloff::of(&offset_energy(material), h.extended).code(&mut w)?.values(h.extended);
    let scales = Scales { weights: &material.weights, profile: &profile, falloff: &falloff };
    let (scaled, seen) = write_offsets(&mut w, material, &scales, slope, price, first, non_negative.offset)?;
    let incident = write_incident(&mut w, material, &scaled, &seen, slope, price, first, non_negative.incident)?;
    // What is left to code is fitted again, to the terms as a decoder sees them.
    let mut decoded = Material {
        header: h.clone(),
        weights: material.weights.clone(),
        incident_factors: incident_tensor(h, &material.weights, &incident, non_negative.incident)?,
        offset_factors: offset_tensor(&scales, &seen)?.into(),
        profile: to_f32("profile", &profile.concat())?,
        lit_mm,
        shift: material.shift.clone(),
        color_coefficients: Vec::new(),
        entry_map: material.entry_map.clone(),
        exit_map: material.exit_map.clone(),
    };
    if let Some(degree) = h.degree {
        write_colors(&mut w, material, &decoded, degree, price, first)?;
    }
    write_through(&mut w, &mut decoded, even, norm, price, first)?;
    Ok(w.finish())
}

fn write_colors(
    w: &mut Writer,
    material: &Material,
    decoded: &Material,
    degree: usize,
    price: Price,
    first: i32,
) -> Result<(), String> {
    let (n, rows) = (degree + 1, material.header.rows());
    let basis = ColorBasis::code(w, Some(&ColorBasis::of(decoded, degree, stride(material))), degree)?;
    let (original, decoded) = (Responses::new(material), Responses::new(decoded));
    let plain: Vec<[Vec<f64>; CHANNELS]> =
        (0..rows).into_par_iter().map(|index| basis.fit(&original, &decoded, degree, index, price)).collect();
    let mut sets = vec![vec![vec![0.0; rows]; CHANNELS]; n];
    for (index, channels) in plain.iter().enumerate() {
        for (c, gamma) in channels.iter().enumerate() {
            gamma.iter().enumerate().for_each(|(p, &g)| sets[p][c][index] = g);
        }
    }
    let rotation = Rotation::decorrelating(moments(&sets)).code(w)?;
    let mut group = Group::new(material.header.points, CHANNELS, first);
    for mut planes in sets {
        rotation.forward(&mut planes);
        for plane in planes {
            group.encode(w, &plane, 1.0, price)?;
        }
    }
    Ok(())
}

fn write_profile(
    w: &mut Writer,
    material: &Material,
    slope: f64,
    price: Price,
    first: i32,
    clip: bool,
) -> Result<Vec<Vec<f64>>, String> {
    let h = &material.header;
    let mut group = Group::new(h.extended, h.offset_planes, first);
    let mut decoded = Vec::new();
    let responses = Responses::new(material);
    for plane in 0..h.offset_planes {
        let Some(profile) = material.profile_plane(plane) else { break };
        let map = to_f64(profile);
        // Σ_i of the terms without the profile, by the middle of what they are over the window
        let terms: f64 = (0..h.rows())
            .step_by(stride(material))
            .map(|i| {
                let row = responses.plane(plane, &[i]);
                row.iter().zip(&map).filter(|(_, m)| **m != 0.0).map(|(v, m)| (v / m).powi(2)).sum::<f64>()
            })
            .sum();
        let sensitivity = PROFILE_FINER * slope * (terms * stride(material) as f64 / map.len() as f64).sqrt();
        let mut map = group.encode(w, &map, sensitivity, price)?;
        clip_below_zero(&mut map, clip);
        decoded.push(as_stored(&map));
    }
    Ok(decoded)
}

/// Writes g·m·h; gives it as it was and as a decoder sees it, \[T\]\[B\]\[samples\].
#[expect(clippy::type_complexity, reason = "two arrays of the same kind")]
fn write_offsets(
    w: &mut Writer,
    material: &Material,
    scales: &Scales<'_>,
    slope: f64,
    price: Price,
    first: i32,
    clip: bool,
) -> Result<(Vec<Vec<Vec<f64>>>, Vec<Vec<Vec<f64>>>), String> {
    let h = &material.header;
    let samples = h.layout().len();
    let all = material.offset_factors.all();
    let scaled: Vec<Vec<Vec<f64>>> = (0..h.terms)
        .map(|j| {
            let plane = |k: usize| {
                let map = &offset_plane(&all, h, k)[j * samples..][..samples];
                let profile = material.profile_plane(k);
                let g = f64::from(material.weights[j]);
                let one = |(e, &v): (usize, &f32)| {
                    g * f64::from(v) * profile.map_or(1.0, |m| f64::from(m[e])) / scales.falloff[e]
                };
                map.iter().enumerate().map(one).collect()
            };
            (0..h.offset_planes).map(plane).collect()
        })
        .collect();
    let rotation = match h.incident_planes == 1 && h.offset_planes == CHANNELS {
        true => Rotation::decorrelating(moments(&scaled)).code(w)?,
        false => Rotation::none(),
    };
    let mut group = Group::new(h.extended, h.offset_planes, first);
    let mut seen = Vec::new();
    for (j, planes) in scaled.iter().enumerate() {
        let mut planes = planes.clone();
        rotation.forward(&mut planes);
        for (k, plane) in planes.iter_mut().enumerate() {
            *plane = group.encode(w, plane, slope * incident_energy(material, k, j).sqrt(), price)?;
        }
        rotation.inverse(&mut planes);
        planes.iter_mut().enumerate().for_each(|(k, plane)| scales.clean(j, k, plane, clip));
        seen.push(planes);
    }
    Ok((scaled, seen))
}

/// Σ (g m h)² over terms and planes at each sample, each times the energy of what it is multiplied by.
fn offset_energy(material: &Material) -> Vec<f64> {
    let (h, all) = (&material.header, material.offset_factors.all());
    let samples = h.layout().len();
    let mut energy = vec![0.0; samples];
    for k in 0..h.offset_planes {
        let profile = material.profile_plane(k);
        for j in 0..h.terms {
            let g = f64::from(material.weights[j]);
            let map = &offset_plane(&all, h, k)[j * samples..][..samples];
            let rows = incident_energy(material, k, j);
            for (e, (sum, &v)) in energy.iter_mut().zip(map).enumerate() {
                *sum += rows * (g * f64::from(v) * profile.map_or(1.0, |m| f64::from(m[e]))).powi(2);
            }
        }
    }
    energy
}

/// Energy of the incident factors that multiply the offset factors of a plane.
fn incident_energy(material: &Material, offset_plane: usize, term: usize) -> f64 {
    let h = &material.header;
    let planes = match (h.incident_planes, h.offset_planes) {
        (CHANNELS, CHANNELS) => offset_plane..offset_plane + 1,
        (planes, _) => 0..planes,
    };
    let of_plane =
        |plane| (0..h.rows()).map(move |i| f64::from(material.incident(plane, i)[term]).powi(2)).sum::<f64>();
    planes.map(of_plane).sum()
}

#[expect(clippy::too_many_arguments, reason = "one step of write_maps, split off for its length")]
fn write_incident(
    w: &mut Writer,
    material: &Material,
    scaled: &[Vec<Vec<f64>>],
    seen: &[Vec<Vec<f64>>],
    slope: f64,
    price: Price,
    first: i32,
    clip: bool,
) -> Result<Vec<Vec<Vec<f64>>>, String> {
    let h = &material.header;
    // The offset planes that each incident plane multiplies, end to end
    let of_plane = |maps: &[Vec<Vec<f64>>], k: usize| -> Vec<Vec<f64>> {
        let join = |planes: &Vec<Vec<f64>>| match h.incident_planes == CHANNELS && h.offset_planes == CHANNELS {
            true => planes[k].clone(),
            false => planes.concat(),
        };
        maps.iter().map(join).collect()
    };
    let mut group = Group::new(h.points, h.incident_planes, first);
    let mut refitted: Vec<Vec<Vec<f64>>> = Vec::new();
    let mut norms: Vec<Vec<f64>> = Vec::new();
    for k in 0..h.incident_planes {
        let column = |j: usize| -> Vec<f64> { (0..h.rows()).map(|i| f64::from(material.incident(k, i)[j])).collect() };
        let columns: Vec<Vec<f64>> = (0..h.terms).map(column).collect();
        let q = of_plane(seen, k);
        // Clipped factors would not be the best ones anyway.
        refitted.push(if clip { columns } else { refit(columns, &of_plane(scaled, k), &q) });
        norms.push(q.iter().map(|map| energy(map).sqrt()).collect());
    }
    let mut decoded = Vec::new();
    for j in 0..h.terms {
        let g = f64::from(material.weights[j]);
        let mut planes = Vec::new();
        for k in 0..h.incident_planes {
            let map: Vec<f64> = refitted[k][j].iter().map(|v| v * g).collect();
            let sensitivity = if g == 0.0 { 0.0 } else { slope * norms[k][j] / g.abs() };
            planes.push(group.encode(w, &map, sensitivity, price)?);
        }
        decoded.push(planes);
    }
    Ok(decoded)
}

fn refit(columns: Vec<Vec<f64>>, scaled: &[Vec<f64>], seen: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let weights = refit_weights(scaled, seen);
    if !weights.iter().flatten().all(|w| w.is_finite()) {
        return columns;
    }
    let rows = columns.first().map_or(0, Vec::len);
    let one = |own: &Vec<f64>| {
        let mut sum = vec![0.0; rows];
        for (w, column) in own.iter().zip(&columns) {
            sum.iter_mut().zip(column).for_each(|(s, v)| *s += w * v);
        }
        sum
    };
    weights.iter().map(one).collect()
}

/// What [`write_maps`] wrote, for a header that was checked.
pub(super) fn read_maps(bytes: &[u8], header: MaterialHeader) -> Result<Material, String> {
    let h = &header;
    let numbers: u128 = h.shapes().iter().map(|(_, shape)| shape.iter().map(|&v| v as u128).product::<u128>()).sum();
    let room = (bytes.len() as u128 * 8 + 64) * MOST_PER_BIT;
    if numbers > room {
        return Err(format!("the header describes {numbers} numbers, more than {} bytes can hold", bytes.len()));
    }
    let mut r = Reader::new(bytes)?;
    let weights = weights(&mut r, &[], &h.singular_values, h.terms)?;
    let shift = shifts(&mut r, &[], h.points)?;
    let lit_mm = positions(&mut r, &[], h.points, 0.0)?;
    let clip = NonNegative { incident: false, offset: false, profile: false }.code(&mut r)?;
    let first = raw(&mut r, 0, 16)? as i32 + LOWEST_STEP;
    let mut profile = Vec::new();
    let mut group = Group::new(h.extended, h.offset_planes, first);
    for _ in 0..if h.profile { h.offset_planes } else { 0 } {
        let mut map = group.decode(&mut r)?;
        clip_below_zero(&mut map, clip.profile);
        profile.push(as_stored(&map));
    }
    let falloff = Falloff::none().code(&mut r)?.values(h.extended);
    let scales = Scales { weights: &weights, profile: &profile, falloff: &falloff };
    let offset_factors = read_offsets(&mut r, h, &scales, first, clip.offset)?;
    let incident_factors = read_incident(&mut r, h, &weights, first, clip.incident)?;
    let color_coefficients = h.degree.map_or(Ok(Vec::new()), |degree| read_colors(&mut r, h, degree, first))?;
    let [entry_map, exit_map] = read_through(&mut r, h, first)?;
    if !r.is_at_end() {
        return Err("coded data: more than the header describes".into());
    }
    let profile = to_f32("profile", &profile.concat())?;
    let material = Material {
        lit_mm,
        weights,
        incident_factors,
        offset_factors: offset_factors.into(),
        profile,
        color_coefficients,
        entry_map,
        exit_map,
        shift,
        header,
    };
    material.check_values()?;
    Ok(material)
}

fn read_colors(r: &mut Reader, h: &MaterialHeader, degree: usize, first: i32) -> Result<Vec<f32>, String> {
    let n = degree + 1;
    let basis = ColorBasis::code(r, None, degree)?;
    let rotation = Rotation::none().code(r)?;
    let mut group = Group::new(h.points, CHANNELS, first);
    let mut sets = Vec::new();
    for _ in 0..n {
        let mut planes = vec![group.decode(r)?, group.decode(r)?, group.decode(r)?];
        rotation.inverse(&mut planes);
        sets.push(planes);
    }
    let mut beta = Vec::new();
    for index in 0..h.rows() {
        for c in 0..CHANNELS {
            let mut gamma: Vec<f64> = sets.iter().map(|planes| planes[c][index]).collect();
            basis.inverse(&mut gamma);
            beta.extend(gamma);
        }
    }
    to_f32("color_coefficients", &beta)
}

fn read_offsets(
    r: &mut Reader,
    h: &MaterialHeader,
    scales: &Scales<'_>,
    first: i32,
    clip: bool,
) -> Result<Vec<f32>, String> {
    let rotation = match h.incident_planes == 1 && h.offset_planes == CHANNELS {
        true => Rotation::none().code(r)?,
        false => Rotation::none(),
    };
    let mut group = Group::new(h.extended, h.offset_planes, first);
    let mut seen = Vec::new();
    for j in 0..h.terms {
        let mut planes = Vec::new();
        for _ in 0..h.offset_planes {
            planes.push(group.decode(r)?);
        }
        rotation.inverse(&mut planes);
        planes.iter_mut().enumerate().for_each(|(k, plane)| scales.clean(j, k, plane, clip));
        seen.push(planes);
    }
    offset_tensor(scales, &seen)
}

/// h as the material keeps it, from g·m·h.
fn offset_tensor(scales: &Scales<'_>, seen: &[Vec<Vec<f64>>]) -> Result<Vec<f32>, String> {
    let mut factors = Vec::new();
    for k in 0..seen.first().map_or(0, Vec::len) {
        for (j, planes) in seen.iter().enumerate() {
            factors.extend(to_f32("offset_factors", &scales.unscaled(j, k, &planes[k]))?);
        }
    }
    Ok(factors)
}

fn read_incident(
    r: &mut Reader,
    h: &MaterialHeader,
    weights: &[f32],
    first: i32,
    clip: bool,
) -> Result<Vec<f32>, String> {
    let mut group = Group::new(h.points, h.incident_planes, first);
    let mut maps = Vec::new();
    for _ in 0..h.terms {
        let mut planes = Vec::new();
        for _ in 0..h.incident_planes {
            planes.push(group.decode(r)?);
        }
        maps.push(planes);
    }
    incident_tensor(h, weights, &maps, clip)
}

/// f as the material keeps it, from g·f, \[T\]\[A\]\[N\].
fn incident_tensor(
    h: &MaterialHeader,
    weights: &[f32],
    maps: &[Vec<Vec<f64>>],
    clip: bool,
) -> Result<Vec<f32>, String> {
    let mut factors = vec![0.0; h.incident_planes * h.rows() * h.terms];
    for (j, (planes, &g)) in maps.iter().zip(weights).enumerate() {
        for (k, map) in planes.iter().enumerate() {
            let mut map: Vec<f64> = map.iter().map(|v| if g == 0.0 { 0.0 } else { v / f64::from(g) }).collect();
            clip_below_zero(&mut map, clip);
            let values = to_f32("incident_factors", &map)?;
            values.iter().enumerate().for_each(|(i, &v)| factors[(k * h.rows() + i) * h.terms + j] = v);
        }
    }
    Ok(factors)
}

fn clip_below_zero(map: &mut [f64], clip: bool) {
    map.iter_mut().filter(|v| clip && **v < 0.0).for_each(|v| *v = 0.0);
}

pub(super) fn to_f64(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

/// Numbers as f32 keeps them.
fn as_stored(values: &[f64]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v as f32)).collect()
}

pub(super) fn to_f32(name: &str, values: &[f64]) -> Result<Vec<f32>, String> {
    match values.iter().position(|v| !(v.abs() <= LARGEST)) {
        Some(at) => Err(format!("{name}: expected numbers up to {LARGEST:e}, found {} at {at}", values[at])),
        None => Ok(values.iter().map(|&v| v as f32).collect()),
    }
}
