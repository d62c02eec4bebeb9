//! Sensors of real devices, by their photon transfer.

use crate::simulate::SensorKind;

/// What photon transfer measures of a sensor, at its own bit depth and base sensitivity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Device {
    pub gain_dn_per_electron: f64,
    /// Noise before the gain, electrons.
    pub read_noise_electrons: f64,
    /// Noise after it, DN.
    pub adc_noise_dn: f64,
    pub bits: u32,
    /// The pedestal, DN: not measured with the rest, but what raw files of such cameras have.
    pub black_dn: f64,
}

impl Device {
    /// Gain and noise as published from photon transfer; the noise of converters dominates but in the A7R.
    pub(crate) const fn of(kind: SensorKind) -> Self {
        let (gain_dn_per_electron, read_noise_electrons, adc_noise_dn, bits, black_dn) = match kind {
            SensorKind::SonyA7r3 => (0.40, 0.71, 3.0, 14, 512.0),
            SensorKind::SonyA7r1 => (0.33, 0.70, 0.04, 14, 512.0),
            SensorKind::CanonT1 => (1.2, 0.94, 5.0, 14, 1024.0),
            SensorKind::Phone => (0.31, 1.06, 2.4, 10, 64.0),
        };
        Self { gain_dn_per_electron, read_noise_electrons, adc_noise_dn, bits, black_dn }
    }

    /// Both noises together, electrons.
    pub(crate) fn noise_electrons(&self) -> f64 {
        self.read_noise_electrons.hypot(self.adc_noise_dn / self.gain_dn_per_electron)
    }
}
