//! One number per lit point, as pictures of the slab: albedo and reconstruction error.

use super::picture::{SrgbPicture, data_url};
use super::row_pictures::bar_scale;
use super::text::significant;
use super::{Files, RowSurvey, color};
use crate::Result;
use crate::transport::MatrixHeader;
use crate::words::plain;

/// Both maps with their scales.
pub(super) fn section(header: &MatrixHeader, survey: &RowSurvey, files: &mut Files) -> Result<String> {
    let mean = survey.mean_albedo.map_or_else(String::new, |mean| {
        // Two digits of the standard deviation, and the value to the same place.
        let channel = |(name, [v, sd]): (&str, [f64; 2])| {
            let sd = plain(sd, 2);
            let places = sd.split_once('.').map_or(0, |(_, places)| places.len());
            format!("{name} {v:.places$} ± {sd}")
        };
        format!(
            "; mean of all rows {}",
            ["R", "G", "B"].into_iter().zip(mean).map(channel).collect::<Vec<_>>().join(", ")
        )
    });
    let title = format!("share of the arriving light that leaves inside the window, mean of the channels{mean}");
    let albedo = Map { values: &survey.albedo, name: "albedo", title: &title, log: false };
    // A few rows may be much worse than the rest: a linear scale would show those only.
    let error = Map {
        values: &survey.error,
        name: "error",
        title: "‖R̂ − R‖ / ‖R‖ of each lit point's row, material against matrix; logarithmic",
        log: true,
    };
    Ok(format!("<div class=\"pair\">{}{}</div>", albedo.figure(header, files)?, error.figure(header, files)?))
}

struct Map<'a> {
    values: &'a [Option<f64>],
    name: &'a str,
    title: &'a str,
    log: bool,
}

impl Map<'_> {
    fn figure(&self, header: &MatrixHeader, files: &mut Files) -> Result<String> {
        let [nx, ny] = header.points;
        let usable = |v: &f64| v.is_finite() && (!self.log || *v > 0.0);
        let scale = |v: f64| if self.log { v.ln() } else { v };
        let known = || self.values.iter().copied().flatten().filter(usable).map(scale);
        let (low, high) = (known().fold(f64::INFINITY, f64::min), known().fold(f64::NEG_INFINITY, f64::max));
        if !(low.is_finite() && high.is_finite()) {
            return Ok(String::new());
        }
        let place = |v: f64| if high > low { (scale(v) - low) / (high - low) } else { 0.5 };
        let at = |x: usize, y: usize| self.values.get(y * nx + x).copied().flatten();
        let picture =
            SrgbPicture::from_fn(nx, ny, |x, y| at(x, y).map_or(color::INVALID, |v| color::sequential(place(v))));
        let png = picture.enlarged(320).png()?;
        let mut out =
            format!("<figure><img class=\"map\" src=\"{}\" alt=\"{} of every lit point\">", data_url(&png), self.name);
        let end = |v: f64| significant(if self.log { v.exp() } else { v }, 3);
        bar_scale(&mut out, color::sequential, [&end(low), &end((low + high) / 2.0), &end(high)], self.title);
        out.push_str("</figure>");
        files.push((format!("{}.png", self.name), png));
        Ok(out)
    }
}
