//! Lights from names and from files.

use super::{Light, LightImage};
use crate::capture::{Samples, decode_exr_bytes, decode_jpeg, decode_png_bytes};
use crate::{Error, Result};
use acquire_material::linear_from_srgb;
use std::path::Path;

/// A built-in light by its name, or else an image file (EXR linear; PNG and JPEG decoded from sRGB).
///
/// # Errors
/// [`Error::Setting`] for a point that cannot be read, [`Error::Io`], [`Error::BrokenImage`].
pub fn parse_light(text: &str) -> Result<Light> {
    match text {
        "spot" => Ok(Light::Spot),
        "stripes" => Ok(Light::Stripes),
        "gradient" => Ok(Light::Gradient),
        "uniform" => Ok(Light::Uniform),
        _ => match text.strip_prefix("point:") {
            Some(at) => {
                let parts: Option<Vec<usize>> = at.split(',').map(|p| p.trim().parse().ok()).collect();
                match parts.as_deref() {
                    Some(&[x, y]) => Ok(Light::Point([x, y])),
                    _ => Err(setting("point:I,J with two grid indices", text)),
                }
            }
            None => Ok(Light::Image(read_light_image(Path::new(text))?)),
        },
    }
}

fn setting(expected: &str, found: &str) -> Error {
    Error::Setting { setting: "light", expected: expected.into(), found: found.into() }
}

/// Reads an image: EXR as linear irradiance, PNG and JPEG decoded from sRGB.
///
/// # Errors
/// [`Error::Io`], [`Error::BrokenImage`].
pub fn read_light_image(path: &Path) -> Result<LightImage> {
    let bytes = crate::files::read(path).map_err(Error::io("read", path))?;
    let broken = |reason: String| Error::BrokenImage { path: path.to_path_buf(), reason };
    let exr_magic = [0x76, 0x2f, 0x31, 0x01];
    let image = if bytes.starts_with(&exr_magic) { read_exr(&bytes) } else { read_encoded(&bytes) };
    let image = image.map_err(broken)?;
    match image.rgb.iter().flatten().position(|v| !(0.0..=LARGEST).contains(v)) {
        Some(at) => {
            let [x, y] = [at / 3 % image.size[0], at / 3 / image.size[0]];
            let found = image.rgb.as_flattened()[at];
            Err(broken(format!("expected an irradiance of 0 to {LARGEST:e}, found {found} in column {x}, line {y}")))
        }
        None => Ok(image),
    }
}

/// The most pixels of a light: those of a camera of 33 megapixels, which take half a gigabyte while they are read.
const MOST_PIXELS: usize = 1 << 25;
/// The largest irradiance: sums of products with any response still fit an f32.
const LARGEST: f32 = 1e20;

fn read_exr(bytes: &[u8]) -> Result<LightImage, String> {
    let (width, height, pixels) = decode_exr_bytes(bytes, MOST_PIXELS)?;
    Ok(LightImage::new([width, height], pixels.as_chunks::<3>().0.to_vec()))
}

fn read_encoded(bytes: &[u8]) -> Result<LightImage, String> {
    let (width, height, samples) = match decode_png_bytes(bytes, MOST_PIXELS) {
        Some(decoded) => decoded?,
        None => decode_jpeg(bytes, MOST_PIXELS)?,
    };
    let rgb = match samples {
        Samples::U8(codes) => {
            let linear: Vec<f32> = (0..=255u8).map(|v| linear_from_srgb(f32::from(v) / 255.0)).collect();
            codes.as_chunks::<3>().0.iter().map(|p| p.map(|v| linear[usize::from(v)])).collect()
        }
        Samples::U16(codes) => {
            let linear = |v: u16| linear_from_srgb(f32::from(v) / 65_535.0);
            codes.as_chunks::<3>().0.iter().map(|p| p.map(linear)).collect()
        }
        Samples::F32(_) => return Err("expected PNG, JPEG or OpenEXR".into()),
    };
    Ok(LightImage::new([width, height], rgb))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_lights_are_read() {
        let names = ["spot", "stripes", "gradient", "uniform", "point: 4, 2"];
        let lights = [Light::Spot, Light::Stripes, Light::Gradient, Light::Uniform, Light::Point([4, 2])];
        for (name, light) in names.into_iter().zip(lights) {
            assert_eq!(parse_light(name).unwrap(), light);
        }
        for wrong in ["point:", "point:1", "point:1,2,3", "point:1,-2", "point:a,2"] {
            assert!(matches!(parse_light(wrong), Err(Error::Setting { setting: "light", .. })), "{wrong}");
        }
        assert!(matches!(parse_light("/no/such/light.png"), Err(Error::Io { .. })));
    }

    #[test]
    fn pictures_are_read_with_their_lines_columns_and_channels() {
        let folder = tempfile::tempdir().unwrap();
        let encoded = |x: u32, y: u32, c: usize| (20 + 30 * x + 90 * y + 7 * c as u32) as u8;
        let png = folder.path().join("light.png");
        image::RgbImage::from_fn(3, 2, |x, y| image::Rgb([0, 1, 2].map(|c| encoded(x, y, c)))).save(&png).unwrap();
        let read = read_light_image(&png).unwrap();
        assert_eq!(read.size, [3, 2]);
        for (k, rgb) in read.rgb.iter().enumerate() {
            for c in 0..3 {
                let v = f64::from(encoded(k as u32 % 3, k as u32 / 3, c)) / 255.0;
                let linear = if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
                assert!((f64::from(rgb[c]) - linear).abs() < 1e-6, "f32 powers: pixel {k} channel {c}");
            }
        }
        let exr = folder.path().join("light.exr");
        let canvas = crate::material::Canvas { origin_mm: [0.0; 2], size: [3, 2], pitch_mm: 1.0 };
        let mut exitance = crate::material::Exitance::new(canvas);
        for c in 0..3 {
            exitance.planes[c] = (0..6).map(|k| (10 * k) as f64 + c as f64 + 0.25).collect();
        }
        crate::material::write_exitance(&exitance, &exr).unwrap();
        let read = read_light_image(&exr).unwrap();
        assert_eq!(read.size, [3, 2]);
        assert_eq!(read.rgb, (0..6).map(|k| [0, 1, 2].map(|c| (10 * k + c) as f32 + 0.25)).collect::<Vec<_>>());
        for (value, refused) in [(1e20, false), (1.1e20, true), (-0.1, true)] {
            exitance.planes[1][4] = value;
            crate::material::write_exitance(&exitance, &exr).unwrap();
            let read = read_light_image(&exr);
            assert_eq!(read.is_err(), refused, "{value}");
            if let Err(error) = read {
                assert!(error.to_string().contains("column 1, line 1"), "{error}");
            }
        }
    }
}
