//! How values of the library's types are spelled on the command line.

use crate::material::{Model, Precision};
use crate::pipeline::Resolution;
use crate::simulate::Cause;
use clap::ValueEnum;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

/// One of `all`, by its name.
fn named<T: Copy + Send + Sync + 'static>(
    all: &'static [T],
    name: fn(T) -> &'static str,
    help: fn(T) -> &'static str,
) -> impl TypedValueParser<Value = T> {
    let values = all.iter().map(|&v| PossibleValue::new(name(v)).help(help(v)));
    // The parser before has refused all other names.
    PossibleValuesParser::new(values).try_map(move |typed| {
        all.iter().copied().find(|&v| name(v) == typed).ok_or_else(|| format!("no value is called {typed}"))
    })
}

/// `--model`.
pub(super) fn model() -> impl TypedValueParser<Value = Model> {
    named(&Model::ALL, Model::name, |model| match model {
        Model::Tucker => "Intensity by error modelling, colour by a polynomial of the intensity per lit point",
        Model::Peers2006 => "The mean profile divided out, the rest a non-negative factorization",
        Model::Joint => "One factorization of the three channels together",
        _ => "",
    })
}

/// `--precision`.
pub(super) fn precision() -> impl TypedValueParser<Value = Precision> {
    named(&Precision::ALL, Precision::name, |precision| match precision {
        Precision::F32 => "As they are, 4 bytes each",
        Precision::F16 => "Rounded to 11 bits, 2 bytes each; not for colour polynomials",
        Precision::Coded => "Transformed, quantized and entropy coded",
    })
}

/// `--accept`.
pub(super) fn finding(typed: &str) -> Result<String, String> {
    match crate::Warning::ids().contains(&typed) {
        true => Ok(typed.to_owned()),
        false => Err("no finding has this name; docs/findings.md lists them".into()),
    }
}

/// The names of an enum's values, and what --help says of them.
macro_rules! values {
    ($type:path { $($variant:ident = $name:literal, $help:literal;)* }) => {
        impl ValueEnum for $type {
            fn value_variants<'a>() -> &'a [Self] {
                &[$(Self::$variant),*]
            }

            fn to_possible_value(&self) -> Option<PossibleValue> {
                Some(match self {
                    $(Self::$variant => PossibleValue::new($name).help($help),)*
                })
            }
        }
    };
}

values!(crate::capture::ExposureFrom {
    Exif = "exif", "EXIF ExposureTime, else ShutterSpeedValue";
    Apex = "apex", "EXIF ShutterSpeedValue (APEX), else ExposureTime";
    Estimate = "estimate", "As `exif`, and then one actual time for each of these nominal ones is measured from the photographs";
});

values!(crate::factor::Backend {
    Full = "full", "The whole matrix in memory, bidiagonalized in f64: 1e-14";
    Gram = "gram", "Eigenvectors of the Gram matrix over columns in f64, one pass: σ_k to 1e-16 σ_1/σ_k, so that those below 1e-8 σ_1 are lost";
    Randomized = "randomized", "Block Krylov subspace from a random start (`Musco2015`), products in f32, as many passes as the asked accuracy needs, then power passes on the found vectors, whose products are as accurate as each is large: down to 1e-6, less where the spectrum is flat";
    Deflation = "deflation", "One term after the other by power iteration on what the earlier ones leave, as the papers describe it, in f32: slow, 1e-4 to 1e-6";
});

impl ValueEnum for Cause {
    fn value_variants<'a>() -> &'a [Self] {
        &Self::ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(PossibleValue::new(self.name()).help(match self {
            Self::Noise => "Photon and read noise",
            Self::Psf => "The lens's point-spread function",
            Self::Glare => "The lens's wide halo",
            Self::Distortion => "Lens distortion",
            Self::Vignetting => "Vignetting",
            Self::HotPixels => "Hot pixels",
            Self::Film => "A film-like response curve that the rig file does not state",
            Self::Exif => "Wrong exposure times in EXIF",
            Self::Flicker => "A lamp that flickers",
            Self::Ambient => "Ambient light",
            Self::Falloff => "Uneven projector light",
            Self::WhiteUnevenness => "An uneven white reference",
            Self::ProjectorBlack => "Light of black projector pixels",
            Self::Blur => "Blurred projector pixels",
            Self::ProjectorDistortion => "Distortion of the projector's lens",
            Self::Drift => "Slow walk of the projected pattern",
            Self::Jumps => "Jumps of the projected pattern",
            Self::CameraDrift => "Slow walk of the camera",
            Self::CameraJumps => "Jumps of the camera",
        }))
    }
}

values!(crate::simulate::FileFormat {
    Png = "png", "16-bit PNG. With a linear response curve it holds the sensor's code values unscaled";
    Tiff = "tiff", "16-bit TIFF, not compressed: the same code values, larger files, decoded at once";
    TiffDeflate = "tiff-deflate", "16-bit TIFF, compressed by Deflate after a difference from the pixel before";
    Jpeg = "jpeg", "8-bit JPEG (quality 95, no chroma subsampling)";
});

values!(crate::simulate::BenchKind {
    Usual = "usual", "Camera nearly above the slab, cells of 0.5 mm, reference dots on the frame";
    Oblique = "oblique", "Camera far away and 30° off the normal, cells of 0.2 mm, no reference dots, a Gray code that moves, uneven light";
});

values!(crate::simulate::SensorKind {
    SonyA7r3 = "sony-a7r3", "Sony A7R III: 14 bits, 7.5 e⁻ of read noise";
    SonyA7r1 = "sony-a7r1", "Sony A7R: 14 bits, 0.7 e⁻";
    CanonT1 = "canon-t1", "Canon T1i: 14 bits, 4.3 e⁻, three times the gain";
    Phone = "phone", "A phone: 10 bits, 7.8 e⁻";
});

values!(crate::simulate::Transport {
    Diffusion = "diffusion", "Diffusion: fast and without noise, wrong near the source and for media that absorb much or scatter little";
    Mc = "mc", "Photon Monte Carlo: right, and noisy";
});

values!(crate::simulate::CameraCurve {
    Linear = "linear", "Code values in proportion to light, above the sensor's black level";
    Srgb = "srgb", "The sRGB curve";
    Film = "film", "A film-like curve with toe and shoulder; the rig file says sRGB, as a lab would guess";
});

values!(crate::simulate::RigCurve {
    Linear = "linear", "Code values in proportion to light";
    Srgb = "srgb", "The sRGB curve";
    Estimate = "estimate", "Unknown, to be estimated";
});

/// `auto`, `full`, or camera pixels across a sample.
/// `yes` or `no`.
pub(super) fn yes_or_no(text: &str) -> Result<bool, String> {
    match text {
        "yes" => Ok(true),
        "no" => Ok(false),
        _ => Err("expected yes or no".into()),
    }
}

pub(super) fn resolution(text: &str) -> Result<Resolution, String> {
    match text {
        "auto" => Ok(Resolution::Auto),
        "full" => Ok(Resolution::Full),
        px => px.parse().map(Resolution::PxPerSample).map_err(|_| "auto, full, or a number of pixels".into()),
    }
}

/// One number for both axes, or two as 30x20.
pub(super) fn pair_of<T: std::str::FromStr + Copy>(text: &str) -> Result<[T; 2], String> {
    let one = |t: &str| t.trim().parse().map_err(|_| format!("a number or two as 30x20, not {text:?}"));
    match text.split_once(['x', '×', ',']) {
        Some((x, y)) => Ok([one(x)?, one(y)?]),
        None => one(text).map(|v| [v; 2]),
    }
}

/// Seconds, also as a fraction: 1/250.
pub(super) fn secs(text: &str) -> Result<f64, String> {
    let number = |t: &str| t.trim().parse::<f64>().map_err(|_| format!("seconds as 0.004 or 1/250, not {text:?}"));
    match text.split_once('/') {
        Some((above, below)) => Ok(number(above)? / number(below)?),
        None => number(text),
    }
}

/// A whole number, also as 1e6.
pub(super) fn whole(text: &str) -> Result<u64, String> {
    let number: f64 = text.parse().map_err(|_| "a number such as 100000 or 1e6".to_owned())?;
    if number.fract() == 0.0 && (0.0..1e15).contains(&number) {
        Ok(number as u64)
    } else {
        Err("a whole number".into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_times_are_read_as_people_write_them() {
        assert_eq!(pair_of::<f64>("20"), Ok([20.0, 20.0]));
        assert_eq!(pair_of::<usize>("40x30"), Ok([40, 30]));
        assert_eq!(pair_of::<f64>("5x-3"), Ok([5.0, -3.0]));
        assert!(pair_of::<usize>("40x").is_err() && pair_of::<usize>("-1").is_err());
        assert_eq!((secs("1/250"), secs("0.5")), (Ok(0.004), Ok(0.5)));
        assert!(secs("1/").is_err() && secs("fast").is_err());
        assert_eq!(whole("1e6"), Ok(1_000_000));
        for wrong in ["1.5", "-3", "many", "1e20"] {
            assert!(whole(wrong).is_err(), "{wrong}");
        }
    }
}
