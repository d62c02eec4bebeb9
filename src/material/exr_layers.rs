//! OpenEXR: every map of a material as a layer that any viewer shows, and single images.

use super::{Canvas, Exitance, Material, legendre};
use crate::output::{SEAL, write_whole};
use crate::{Error, Result};
use exr::prelude::{
    AnyChannel, AnyChannels, AttributeValue, Encoding, FlatSamples, Image, ImageAttributes, IntegerBounds, Layer,
    LayerAttributes, SmallVec, Text, Vec2, WritableImage,
};
use std::path::Path;

type FlatLayer = Layer<AnyChannels<FlatSamples>>;

/// Writes one part per map: `f_j` (points; the weight g_j is multiplied into it), `h_j` (offsets), `profile` (offsets),
/// `color_p` (RGB, powers of the intensity, points), `entry` (points) and `exit` (the exit map's grid) where there are
/// such maps, and `shift` (X, Y, points). Maps that the channels share are Y, others RGB.
///
/// # Errors
/// [`Error::Io`], [`Error::Internal`].
pub fn export_exr(material: &Material, path: &Path) -> Result<()> {
    let h = &material.header;
    let (terms, samples) = (h.terms, h.layout().len());
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
        layers.push(layer(&format!("f_{j:02}"), h.points, planes(h.incident_planes, &map)));
    }
    let offsets = material.offset_factors.all();
    for j in 0..terms {
        let map = |k: usize| offsets[(k * terms + j) * samples..][..samples].to_vec();
        layers.push(layer(&format!("h_{j:02}"), h.extended, planes(h.offset_planes, &map)));
    }
    if h.profile {
        let map = |k: usize| material.profile_plane(k).unwrap_or_default().to_vec();
        layers.push(layer("profile", h.extended, planes(h.offset_planes, &map)));
    }
    if let Some(degree) = h.degree {
        let powers = degree + 1;
        let monomials = monomial_coefficients(material);
        for p in 0..powers {
            let channel =
                |c: usize| monomials.iter().skip(c * powers + p).step_by(3 * powers).map(|&v| v as f32).collect();
            layers.push(layer(&format!("color_{p:02}"), h.points, planes(3, &channel)));
        }
    }
    if let Some(grid) = h.exit_grid {
        for (name, map, size) in [("entry", &material.entry_map, h.points), ("exit", &material.exit_map, grid.size)] {
            let plane = |k: usize| map[k * size[0] * size[1]..][..size[0] * size[1]].to_vec();
            layers.push(layer(name, size, planes(grid.planes, &plane)));
        }
    }
    let along = |a: usize| material.shift.iter().map(|s| f32::from(s[a])).collect();
    layers.push(layer("shift", h.points, vec![("X", along(0)), ("Y", along(1))]));
    write_layers(path, layers)
}

/// Writes an exitance as linear RGB, with the attributes `originMm` (centre of the first sample), `pitchMm` and `unit`.
///
/// # Errors
/// [`Error::Io`], [`Error::Internal`].
pub fn write_exitance(exitance: &Exitance, path: &Path) -> Result<()> {
    let plane = |c: usize| exitance.planes[c].iter().map(|&v| v as f32).collect();
    let maps = vec![("R", plane(0)), ("G", plane(1)), ("B", plane(2))];
    let mut layer = layer("exitance", exitance.canvas.size, maps);
    let Canvas { origin_mm, pitch_mm, .. } = exitance.canvas;
    let unit = "radiant exitance, in the unit that the light's irradiance has";
    let known = [
        ("originMm", AttributeValue::FloatVec2(Vec2(origin_mm[0] as f32, origin_mm[1] as f32))),
        ("pitchMm", AttributeValue::F32(pitch_mm as f32)),
        ("unit", AttributeValue::Text(Text::from(unit))),
    ];
    layer.attributes.other.extend(known.map(|(name, value)| (Text::from(name), value)));
    write_layers(path, vec![layer])
}

/// β as coefficients of powers of the intensity, \[N, 3, P+1\], lowest power first; empty without a polynomial.
pub(super) fn monomial_coefficients(material: &Material) -> Vec<f64> {
    let Some(degree) = material.header.degree else { return Vec::new() };
    let [low, high] = material.header.intensity_range.map(f64::from);
    let polynomials = material.color_coefficients.chunks_exact(degree + 1);
    polynomials.flat_map(|beta| legendre::monomials(beta, low, high)).collect()
}

fn layer(name: &str, size: [usize; 2], channels: Vec<(&str, Vec<f32>)>) -> FlatLayer {
    let channels: SmallVec<[AnyChannel<FlatSamples>; 4]> =
        channels.into_iter().map(|(name, values)| AnyChannel::new(name, FlatSamples::F32(values))).collect();
    let attributes = LayerAttributes::named(name);
    Layer::new((size[0], size[1]), attributes, Encoding::FAST_LOSSLESS, AnyChannels::sort(channels))
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

    fn layers(path: &Path) -> Vec<Found> {
        let image = read()
            .no_deep_data()
            .largest_resolution_level()
            .all_channels()
            .all_layers()
            .all_attributes()
            .from_file(path)
            .unwrap();
        let layer = |l: &FlatLayer| {
            let channel = |c: &AnyChannel<FlatSamples>| (c.name.to_string(), c.sample_data.values_as_f32().collect());
            let name = l.attributes.layer_name.as_ref().unwrap().to_string();
            (name, [l.size.0, l.size.1], l.channel_data.list.iter().map(channel).collect())
        };
        image.layer_data.iter().map(layer).collect()
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
}
