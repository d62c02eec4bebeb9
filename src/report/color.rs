//! Colours of the report: tone mapping of radiance, false-colour scales.

/// An sRGB colour.
pub(super) type Rgb = [u8; 3];

/// What was not measured: a grey that no scale below contains.
pub(super) const INVALID: Rgb = [128, 128, 128];

/// Dark to bright, perceptually even and readable by colour-blind eyes (the "inferno" scale of matplotlib, at ten
/// places).
const SEQUENTIAL: [Rgb; 10] = [
    [0, 0, 4],
    [27, 12, 65],
    [74, 12, 107],
    [120, 28, 109],
    [165, 44, 96],
    [207, 68, 70],
    [237, 105, 37],
    [251, 155, 6],
    [247, 209, 61],
    [252, 255, 164],
];

/// Blue below, white at zero, red above (ColorBrewer "RdBu", turned).
const DIVERGING: [Rgb; 11] = [
    [5, 48, 97],
    [33, 102, 172],
    [67, 147, 195],
    [146, 197, 222],
    [209, 229, 240],
    [247, 247, 247],
    [253, 219, 199],
    [244, 165, 130],
    [214, 96, 77],
    [178, 24, 43],
    [103, 0, 31],
];

/// How many exposures measured a pixel: none, then from few to many. Beyond the last the last is used.
const COUNTS: [Rgb; 7] =
    [[214, 39, 90], [243, 192, 77], [196, 206, 110], [127, 191, 139], [78, 163, 157], [62, 127, 158], [63, 88, 143]];

/// The sequential scale at `t` in 0..=1; values outside are clamped.
pub(super) fn sequential(t: f64) -> Rgb {
    between(&SEQUENTIAL, t)
}

/// The diverging scale at `t` in −1..=1; values outside are clamped.
pub(super) fn diverging(t: f64) -> Rgb {
    between(&DIVERGING, 0.5 * (t + 1.0))
}

/// The colour of a pixel that `n` exposures measured.
pub(super) fn count(n: usize) -> Rgb {
    COUNTS[n.min(COUNTS.len() - 1)]
}

/// `#rrggbb`.
pub(super) fn hex(c: Rgb) -> String {
    format!("#{:02x}{:02x}{:02x}", c[0], c[1], c[2])
}

/// A position 0..=1 on a logarithmic scale that ends at `top` and spans `decades` below it.
pub(super) fn log_position(value: f64, top: f64, decades: f64) -> f64 {
    if value > 0.0 && top > 0.0 { ((value / top).log10() / decades + 1.0).clamp(0.0, 1.0) } else { 0.0 }
}

/// Linear RGB radiance to display colour, with a logarithmic curve that keeps the ratios of the channels.
///
/// `white` is the luminance that becomes white. The curve is ln(1 + 500 L/white) / ln 501: dots and their faint
/// surroundings are both seen.
pub(super) fn tone_map(rgb: [f32; 3], white: f32) -> Rgb {
    const STRENGTH: f32 = 500.0;
    let luminance = luminance(rgb).max(0.0);
    if !(luminance > 0.0 && white > 0.0) {
        return [0; 3];
    }
    let bright = (STRENGTH * luminance / white).ln_1p() / STRENGTH.ln_1p();
    // The curve is already about as even to the eye as sRGB's; only the channels' ratios need its encoding.
    rgb.map(|c| (255.0 * bright * (c.max(0.0) / luminance).powf(1.0 / 2.2)).round().clamp(0.0, 255.0) as u8)
}

/// Luminance of linear Rec. 709 RGB.
pub(super) fn luminance(rgb: [f32; 3]) -> f32 {
    0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2]
}

fn between<const N: usize>(stops: &[Rgb; N], t: f64) -> Rgb {
    let t = if t.is_finite() { t.clamp(0.0, 1.0) } else { 0.0 } * (N - 1) as f64;
    let i = (t as usize).min(N - 2);
    let f = t - i as f64;
    std::array::from_fn(|c| (f64::from(stops[i][c]) * (1.0 - f) + f64::from(stops[i + 1][c]) * f).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_meet_their_ends_and_their_middle() {
        assert_eq!((sequential(-1.0), sequential(1.0)), (SEQUENTIAL[0], SEQUENTIAL[9]));
        assert_eq!((diverging(-9.0), diverging(0.0), diverging(1.0)), (DIVERGING[0], DIVERGING[5], DIVERGING[10]));
        assert_eq!(sequential(f64::NAN), SEQUENTIAL[0]);
    }

    #[test]
    fn a_decade_is_one_part_of_the_logarithmic_scale() {
        assert!((log_position(0.1, 1.0, 4.0) - 0.75).abs() < 1e-12);
        assert_eq!((log_position(0.0, 1.0, 4.0), log_position(-1.0, 1.0, 4.0)), (0.0, 0.0));
    }

    #[test]
    fn tone_mapping_is_monotone_and_keeps_grey_grey() {
        let mut last = 0;
        for i in 0..40 {
            let c = tone_map([1.5_f32.powi(i - 39); 3], 1.0);
            assert!(c[0] == c[1] && c[1] == c[2] && c[0] >= last);
            last = c[0];
        }
        assert_eq!(last, 255);
        assert_eq!(tone_map([0.0; 3], 1.0), [0; 3]);
    }
}
