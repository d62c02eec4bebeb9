//! OpenEXR: every map of a material as a layer that any viewer shows, and single images.

use super::{Canvas, Exitance, Material, legendre};
use crate::geometry::Point;
use crate::output::{SEAL, write_whole};
use crate::{Error, Result};
use exr::prelude::{
    AnyChannel, AnyChannels, AttributeValue, Encoding, FlatSamples, Image, ImageAttributes, IntegerBounds, Layer,
    LayerAttributes, SmallVec, Text, Vec2, WritableImage,
};
use std::path::Path;

type FlatLayer = Layer<AnyChannels<FlatSamples>>;

/// What the samples of a part are, in the attributes of its header.
#[derive(Debug, Clone, Copy)]
struct PartGrid {
    axes: &'static str,
    size: [usize; 2],
    origin_mm: Point,
    pitch_mm: Point,
}

impl PartGrid {
    /// One sample a lit point. Where they really are, the part `lit` has.
    fn points(material: &Material) -> Self {
        let h = &material.header;
        let origin_mm = material.lit_mm.first().copied().unwrap_or_default();
        Self { axes: "lit points x_i", size: h.points, origin_mm, pitch_mm: h.lit_pitch_mm }
    }

    /// Offsets of the common window; a row's are those plus its shift.
    fn offsets(material: &Material) -> Self {
        let h = &material.header;
        let origin_mm = h.extended.map(|n| -((n / 2) as f64) * h.pitch_mm);
        Self {
            axes: "offsets x_o - x_i, of a row less its shift",
            size: h.extended,
            origin_mm,
            pitch_mm: [h.pitch_mm; 2],
        }
    }

    fn outgoing(size: [usize; 2], origin_mm: Point, pitch_mm: f64) -> Self {
        Self { axes: "outgoing points x_o", size, origin_mm, pitch_mm: [pitch_mm; 2] }
    }
}

/// Writes one part per map: `f_j` (points; the weight g_j is multiplied into it), `h_j` (offsets), `profile` (offsets),
/// `color_p` (RGB, powers of the intensity, points), `entry` (points) and `exit` (the exit map's grid) where there are
/// such maps, `shift` (X, Y, points) and `lit` (X, Y, mm, points). Maps that the channels share are Y, others RGB.
/// Every part has the attributes of [`write_exitance`].
///
/// # Errors
/// [`Error::Io`], [`Error::Internal`].
pub fn export_exr(material: &Material, path: &Path) -> Result<()> {
    let h = &material.header;
    let (terms, samples) = (h.terms, h.layout().len());
    let (points, offset_grid) = (PartGrid::points(material), PartGrid::offsets(material));
    let units = Units::of(material);
    let planes = |count: usize, map: &dyn Fn(usize) -> Vec<f32>| match count {
        1 => vec![("Y", map(0))],
        _ => ["R", "G", "B"].into_iter().enumerate().map(|(k, name)| (name, map(k))).collect(),
    };
    let mut layers = Vec::new();
    for j in 0..terms {
        let g = material.weights[j];
        let map = |k: usize| {
            let plane = &material.incident_factors[k * h.rows() * terms..][..h.rows() * terms];
            plane.iter().skip(j).step_by(terms).map(|f| g * f).collect()
        };
        layers.push(layer(&format!("f_{j:02}"), points, units.incident, planes(h.incident_planes, &map)));
    }
    let offsets = material.offset_factors.all();
    for j in 0..terms {
        let map = |k: usize| offsets[(k * terms + j) * samples..][..samples].to_vec();
        layers.push(layer(&format!("h_{j:02}"), offset_grid, "1", planes(h.offset_planes, &map)));
    }
    if h.profile {
        let map = |k: usize| material.profile_plane(k).unwrap_or_default().to_vec();
        layers.push(layer("profile", offset_grid, units.profile, planes(h.offset_planes, &map)));
    }
    if let Some(degree) = h.degree {
        let powers = degree + 1;
        let monomials = monomial_coefficients(material);
        for p in 0..powers {
            let channel =
                |c: usize| monomials.iter().skip(c * powers + p).step_by(3 * powers).map(|&v| v as f32).collect();
            layers.push(layer(&format!("color_{p:02}"), points, PER_MM2, planes(3, &channel)));
        }
    }
    if let Some(grid) = h.exit_grid {
        let exit = PartGrid::outgoing(grid.size, grid.origin_mm, h.pitch_mm);
        for (name, map, on) in [("entry", &material.entry_map, points), ("exit", &material.exit_map, exit)] {
            let plane = |k: usize| map[k * on.size[0] * on.size[1]..][..on.size[0] * on.size[1]].to_vec();
            layers.push(layer(name, on, "1", planes(grid.planes, &plane)));
        }
    }
    let along = |a: usize| material.shift.iter().map(|s| f32::from(s[a])).collect();
    layers.push(layer("shift", points, "samples", vec![("X", along(0)), ("Y", along(1))]));
    let place = |a: usize| material.lit_mm.iter().map(|p| p[a] as f32).collect();
    layers.push(layer("lit", points, "mm", vec![("X", place(0)), ("Y", place(1))]));
    write_layers(path, layers)
}

/// mm⁻²; OpenEXR's texts are plain.
const PER_MM2: &str = "mm^-2";

/// Units of the maps that have one in some models only.
struct Units {
    incident: &'static str,
    profile: &'static str,
}

impl Units {
    /// The intensity that a colour polynomial takes has none. Else the profile has mm⁻², or what is summed.
    fn of(material: &Material) -> Self {
        match (material.header.degree.is_some(), material.header.profile) {
            (true, _) => Self { incident: "1", profile: "1" },
            (false, true) => Self { incident: "1", profile: PER_MM2 },
            (false, false) => Self { incident: PER_MM2, profile: "1" },
        }
    }
}

/// Writes an exitance as linear RGB. Attributes, which programs that do not know them leave alone:
/// `acquire:originMm` (x and y of the middle of the first sample), `acquire:pitchMm` (steps along x and y),
/// `acquire:unit` of the values and `acquire:axes`, what the samples are.
///
/// # Errors
/// [`Error::Io`], [`Error::Internal`].
pub fn write_exitance(exitance: &Exitance, path: &Path) -> Result<()> {
    let plane = |c: usize| exitance.planes[c].iter().map(|&v| v as f32).collect();
    let maps = vec![("R", plane(0)), ("G", plane(1)), ("B", plane(2))];
    let Canvas { origin_mm, size, pitch_mm } = exitance.canvas;
    let unit = "radiant exitance, in the unit that the light's irradiance has";
    write_layers(path, vec![layer("exitance", PartGrid::outgoing(size, origin_mm, pitch_mm), unit, maps)])
}

/// β as coefficients of powers of the intensity, \[N, 3, P+1\], lowest power first; empty without a polynomial.
pub(super) fn monomial_coefficients(material: &Material) -> Vec<f64> {
    let Some(degree) = material.header.degree else { return Vec::new() };
    let [low, high] = material.header.intensity_range.map(f64::from);
    let polynomials = material.color_coefficients.chunks_exact(degree + 1);
    polynomials.flat_map(|beta| legendre::monomials(beta, low, high)).collect()
}

fn layer(name: &str, grid: PartGrid, unit: &str, channels: Vec<(&str, Vec<f32>)>) -> FlatLayer {
    let channels: SmallVec<[AnyChannel<FlatSamples>; 4]> =
        channels.into_iter().map(|(name, values)| AnyChannel::new(name, FlatSamples::F32(values))).collect();
    let mut attributes = LayerAttributes::named(name);
    let pair = |v: Point| AttributeValue::FloatVec2(Vec2(v[0] as f32, v[1] as f32));
    let text = |v: &str| AttributeValue::Text(Text::from(v));
    attributes.other.extend(
        [
            ("acquire:originMm", pair(grid.origin_mm)),
            ("acquire:pitchMm", pair(grid.pitch_mm)),
            ("acquire:unit", text(unit)),
            ("acquire:axes", text(grid.axes)),
        ]
        .map(|(name, value)| (Text::from(name), value)),
    );
    Layer::new((grid.size[0], grid.size[1]), attributes, Encoding::FAST_LOSSLESS, AnyChannels::sort(channels))
}

fn write_layers(path: &Path, mut layers: Vec<FlatLayer>) -> Result<()> {
    for layer in &layers {
        for channel in &layer.channel_data.list {
            if let FlatSamples::F32(values) = &channel.sample_data
                && let Some(at) = values.iter().position(|v| !v.is_finite())
            {
                let name = layer.attributes.layer_name.as_ref().map(ToString::to_string).unwrap_or_default();
                let (found, at) = (values[at].into(), format!("sample {at} of layer {name}, channel {}", channel.name));
                return Err(Error::NotFinite { path: path.to_path_buf(), field: "image", found, at });
            }
        }
    }
    // Parts may differ in size, but a file has one display window: the smallest that holds them all.
    let size = layers.iter().fold(Vec2(1, 1), |s, l| Vec2(s.0.max(l.size.0), s.1.max(l.size.1)));
    let attributes = ImageAttributes::new(IntegerBounds::from_dimensions(size));
    if let Some(first) = layers.first_mut() {
        first.attributes.software_name = Some(Text::from(SEAL));
    }
    let image = Image::from_layers(attributes, layers);
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write().to_buffered(&mut bytes).map_err(Error::internal)?;
    write_whole(path, bytes.into_inner())
}

/// Writes an 8-bit PNG under a temporary name, then renames it.
///
/// # Errors
/// [`Error::Io`], [`Error::Internal`].
pub fn write_png(image: &image::RgbImage, path: &Path) -> Result<()> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, image.width(), image.height());
    encoder.set_color(png::ColorType::Rgb);
    encoder.add_text_chunk("Software".into(), SEAL.into()).map_err(Error::internal)?;
    let mut writer = encoder.write_header().map_err(Error::internal)?;
    writer.write_image_data(image.as_raw()).map_err(Error::internal)?;
    writer.finish().map_err(Error::internal)?;
    write_whole(path, bytes)
}

#[cfg(test)]
mod tests {
    use super::super::naive;
    use super::*;
    use exr::prelude::{ReadChannels, ReadLayers, read};

    /// Name, size, and channels by name.
    type Found = (String, [usize; 2], Vec<(String, Vec<f32>)>);

    fn parts(path: &Path) -> Vec<FlatLayer> {
        let levels = read().no_deep_data().largest_resolution_level();
        let image = levels.all_channels().all_layers().all_attributes().from_file(path).unwrap();
        image.layer_data.into_vec()
    }

    fn layers(path: &Path) -> Vec<Found> {
        let layer = |l: &FlatLayer| {
            let channel = |c: &AnyChannel<FlatSamples>| (c.name.to_string(), c.sample_data.values_as_f32().collect());
            let name = l.attributes.layer_name.as_ref().unwrap().to_string();
            (name, [l.size.0, l.size.1], l.channel_data.list.iter().map(channel).collect())
        };
        parts(path).iter().map(layer).collect()
    }

    #[test]
    fn maps_are_layers_of_their_own_size_under_their_names() {
        let folder = tempfile::tempdir().unwrap();
        for m in naive::materials() {
            let path = folder.path().join("m.exr");
            export_exr(&m, &path).unwrap();
            let found = layers(&path);
            let h = &m.header;
            let get = |name: &str, channel: &str, size: [usize; 2]| -> Vec<f32> {
                let layer = found.iter().find(|l| l.0 == name).unwrap_or_else(|| panic!("no layer {name}"));
                assert_eq!(layer.1, size, "{name}");
                layer.2.iter().find(|c| c.0 == channel).unwrap_or_else(|| panic!("no {channel} in {name}")).1.clone()
            };
            let names = |planes: usize| if planes == 1 { vec!["Y"] } else { vec!["R", "G", "B"] };
            for j in 0..3 {
                for (k, name) in names(h.incident_planes).into_iter().enumerate() {
                    let map = get(&format!("f_{j:02}"), name, naive::POINTS);
                    let expected = (0..15).map(|i| m.weights[j] * m.incident_factors[(k * 15 + i) * 3 + j]);
                    assert_eq!(map, expected.collect::<Vec<_>>(), "f_{j} {name}");
                }
                for (k, name) in names(h.offset_planes).into_iter().enumerate() {
                    let map = get(&format!("h_{j:02}"), name, naive::EXTENDED);
                    assert_eq!(map, m.offset_factors.all()[(k * 3 + j) * 63..][..63], "h_{j} {name}");
                }
            }
            if h.profile {
                for (k, name) in names(h.offset_planes).into_iter().enumerate() {
                    assert_eq!(get("profile", name, naive::EXTENDED), m.profile[k * 63..][..63]);
                }
            }
            for (a, name) in ["X", "Y"].into_iter().enumerate() {
                let shifts: Vec<f32> = m.shift.iter().map(|s| f32::from(s[a])).collect();
                assert_eq!(get("shift", name, naive::POINTS), shifts);
                assert_eq!(get("lit", name, naive::POINTS), m.lit_mm.iter().map(|p| p[a] as f32).collect::<Vec<_>>());
            }
            let Some(degree) = h.degree else { continue };
            for (c, name) in ["R", "G", "B"].into_iter().enumerate() {
                let powers: Vec<Vec<f32>> =
                    (0..=degree).map(|p| get(&format!("color_{p:02}"), name, naive::POINTS)).collect();
                for i in 0..15 {
                    for v in [-0.6, 0.1, 1.3] {
                        let found: f64 = (0..=degree).map(|p| f64::from(powers[p][i]) * f64::powi(v, p as i32)).sum();
                        let expected = naive::colored(&m, i, [v; 3])[c];
                        assert!((found - expected).abs() < 1e-5, "f32 coefficients of size 10: {found} {expected}");
                    }
                }
            }
        }
    }

    /// Origin, pitch, unit and axes of every part, by its name.
    fn attributes(path: &Path) -> Vec<(String, [[f32; 2]; 2], [String; 2])> {
        let of = |l: &FlatLayer| {
            let get = |name: &str| l.attributes.other.get(&Text::from(name)).unwrap_or_else(|| panic!("no {name}"));
            let pair = |name| match get(name) {
                AttributeValue::FloatVec2(Vec2(x, y)) => [*x, *y],
                other => panic!("{name}: {other:?}"),
            };
            let text = |name| match get(name) {
                AttributeValue::Text(text) => text.to_string(),
                other => panic!("{name}: {other:?}"),
            };
            let name = l.attributes.layer_name.as_ref().unwrap().to_string();
            (name, [pair("acquire:originMm"), pair("acquire:pitchMm")], [text("acquire:unit"), text("acquire:axes")])
        };
        parts(path).iter().map(of).collect()
    }

    #[test]
    fn every_part_says_where_its_samples_are_and_in_which_unit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("e.exr");
        let canvas = Canvas { origin_mm: [-1.25, 3.5], size: [4, 3], pitch_mm: 0.2 };
        write_exitance(&Exitance::new(canvas), &path).unwrap();
        let [(name, grid, [unit, axes])] = &attributes(&path)[..] else { panic!("one part") };
        assert_eq!(
            (name.as_str(), *grid, axes.as_str()),
            ("exitance", [[-1.25, 3.5], [0.2; 2]], "outgoing points x_o")
        );
        assert!(unit.starts_with("radiant exitance"), "{unit}");
        for m in naive::materials() {
            export_exr(&m, &path).unwrap();
            let found = attributes(&path);
            let first = m.lit_mm[0].map(|v| v as f32);
            // 9 × 7 samples of half a millimetre around the lit point.
            for (part, grid) in
                [("f_00", [first, [0.75, 1.0]]), ("lit", [first, [0.75, 1.0]]), ("h_02", [[-2.0, -1.5], [0.5; 2]])]
            {
                assert_eq!(found.iter().find(|f| f.0 == part).unwrap().1, grid, "{part}");
            }
            // What has mm⁻² is one of them: colours, the profile, or what is summed.
            let per_mm2 = |part: &str| found.iter().any(|f| f.0.starts_with(part) && f.2[0] == "mm^-2");
            let h = &m.header;
            assert_eq!(per_mm2("color"), h.degree.is_some());
            assert_eq!(per_mm2("profile"), h.degree.is_none() && h.profile);
            assert_eq!(per_mm2("f_"), h.degree.is_none() && !h.profile);
            if let Some(grid) = h.exit_grid {
                let exit = found.iter().find(|f| f.0 == "exit").unwrap();
                assert_eq!(exit.1, [grid.origin_mm.map(|v| v as f32), [0.5; 2]]);
            }
        }
    }
}
