//! What the rig says of the sensor, so that light which another scene would have given also has that light's noise.

use rand::RngExt;
use rand_distr::StandardNormal;
use rand_pcg::Pcg64;

/// Light is counted in DN above black, of the linear signal.
#[derive(Debug, Clone)]
pub(crate) struct Sensor {
    pub black: f64,
    pub saturation: f64,
    pub gain: f64,
    pub read_dn: f64,
    /// Bits of the linear code values; 8 with a response curve.
    pub bits: u32,
    srgb: bool,
}

impl Sensor {
    /// `None` without `[noise]`.
    pub(crate) fn of(rig: &toml::Table) -> Option<Self> {
        let noise = rig.get("noise")?;
        let figure = |name: &str| noise[name].as_float().or(noise[name].as_integer().map(|i| i as f64)).unwrap();
        let (saturation, gain) = (figure("saturation_dn"), figure("gain_dn_per_electron"));
        Some(Self {
            black: figure("black_dn"),
            saturation,
            gain,
            read_dn: gain * figure("read_noise_electrons"),
            // The rig calls a pixel saturated a little below the largest code.
            bits: (saturation + 1.0).log2().ceil() as u32,
            srgb: rig["camera"]["response"].as_str() == Some("srgb"),
        })
    }

    /// The largest linear code value.
    pub(crate) fn largest(&self) -> f64 {
        f64::from(2u32.pow(self.bits) - 1)
    }

    /// From black to saturation, DN.
    pub(crate) fn range(&self) -> f64 {
        self.saturation - self.black
    }

    pub(crate) fn light(&self, code: u16) -> f64 {
        let code = f64::from(code);
        if self.srgb { 255.0 * decode(code / 255.0) - self.black } else { code - self.black }
    }

    /// The code value of this light, rounded and clipped as the file's format has it.
    pub(crate) fn code(&self, light: f64) -> u16 {
        let dn = (light + self.black).clamp(0.0, self.largest());
        (if self.srgb { 255.0 * encode(dn / 255.0) } else { dn }).round() as u16
    }

    pub(crate) fn saturated(&self, light: f64) -> bool {
        light >= self.range() * (1.0 - 1e-9)
    }

    /// Of light that was photographed once, DN².
    pub(crate) fn variance(&self, light: f64) -> f64 {
        self.gain * light.max(0.0) + self.read_dn * self.read_dn
    }
}

/// A deviate of this variance; none is needed where it is not above zero.
pub(crate) fn deviate(generator: &mut Pcg64, variance: f64) -> f64 {
    if variance > 0.0 { variance.sqrt() * generator.sample::<f64, _>(StandardNormal) } else { 0.0 }
}

/// sRGB: encoded to linear, both 0 to 1.
fn decode(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// sRGB: linear to encoded, both 0 to 1.
pub(crate) fn encode(v: f64) -> f64 {
    if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}
