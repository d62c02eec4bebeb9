//! Do the photographs, in their order, have the exposures that the plan asks for?

use super::files::Found;
use crate::patterns::Plan;
use crate::words::count;
use crate::{Error, Result};

/// Half a third of a stop: nominal times (1/30 for 1/32) are nearer, the next step of a camera is further.
const SAME_EXPOSURE: f64 = 0.122;
/// So many photographs after a mismatch decide whether one is missing or doubled.
const AHEAD: usize = 12;

/// Refuses photographs that are not those of the plan, one after another; the error names the first that is not.
///
/// # Errors
/// [`Error::DoesNotFit`].
///
/// Not detected: photographs of another pattern with the same exposures (`acquire check` sees dots that are not there).
pub fn fit(photographs: &[Found], plan: &Plan) -> Result<()> {
    let expected: Vec<(usize, usize, f64)> = (0..plan.shots.len())
        .flat_map(|s| plan.shots[s].exposures_secs.iter().enumerate().map(move |(n, &t)| (s, n, t)))
        .collect();
    let same = |found: Option<&Found>, expected: Option<&(usize, usize, f64)>| match (found, expected) {
        (Some(found), Some(expected)) => {
            found.settings.exposure_secs.is_some_and(|secs| (secs / expected.2).ln().abs() < SAME_EXPOSURE)
        }
        _ => false,
    };
    let first = (0..photographs.len().max(expected.len())).find(|&k| !same(photographs.get(k), expected.get(k)));
    let Some(k) = first else { return Ok(()) };
    let describe = |e: &(usize, usize, f64)| {
        let of = plan.shots[e.0].exposures_secs.len();
        format!("exposure {} of {of}, {}", e.1 + 1, time(e.2))
    };
    let Some(at) = expected.get(k) else {
        let Some(extra) = photographs.get(k) else { return Ok(()) };
        let last = expected.last().map_or(0, |e| e.0);
        return Err(Error::DoesNotFit {
            path: extra.path.clone(),
            shot: plan.shots[last].name.clone(),
            expected: format!("no more than the plan's {}", count(expected.len(), "photograph")),
            found: count(photographs.len(), "photograph"),
        });
    };
    let shot = plan.shots[at.0].name.clone();
    let Some(found) = photographs.get(k) else {
        let path = photographs.last().map(|p| p.path.clone()).unwrap_or_default();
        let found = format!("the last photograph, {} of {}", photographs.len(), expected.len());
        return Err(Error::DoesNotFit { path, shot, expected: format!("{} after it", describe(at)), found });
    };
    // How many of those that follow fit when one is missing here, or one too many.
    let run = |f: usize, e: usize| (0..AHEAD).take_while(|i| same(photographs.get(f + i), expected.get(e + i))).count();
    let (missing, doubled) = (run(k, k + 1), run(k + 1, k));
    let fewer = photographs.len() < expected.len();
    let verdict = match () {
        () if found.settings.exposure_secs.is_none() => "",
        () if missing > 0 && (missing > doubled || missing == doubled && fewer) => {
            ": a photograph is missing before it"
        }
        () if doubled > 0 => ": it is an extra one",
        () => "",
    };
    let secs = found.settings.exposure_secs.map_or("no exposure time in EXIF".to_owned(), time);
    Err(Error::DoesNotFit { path: found.path.clone(), shot, expected: describe(at), found: format!("{secs}{verdict}") })
}

/// Refuses photographs whose settings changed; the error names the first that differs from the first of all.
///
/// # Errors
/// [`Error::DoesNotFit`].
pub fn same_settings(photographs: &[Found], plan: &Plan) -> Result<()> {
    let Some(first) = photographs.first() else { return Ok(()) };
    let number = |v: Option<f64>| v.map(|v| format!("{}", (v * 100.0).round() / 100.0));
    type Read<'a> = &'a dyn Fn(&Found) -> Option<String>;
    let settings: [(&str, Read); 6] = [
        ("size", &|p| p.size_px.map(|[w, h]| format!("{w} × {h} px"))),
        ("ISO", &|p| number(p.settings.iso)),
        ("f-number", &|p| number(p.settings.f_number)),
        ("focal length", &|p| number(p.settings.focal_mm)),
        ("white balance", &|p| {
            p.settings.automatic_white_balance.map(|a| if a { "automatic" } else { "manual" }.into())
        }),
        ("camera", &|p| p.settings.camera.clone()),
    ];
    let shots: Vec<usize> =
        (0..plan.shots.len()).flat_map(|s| plan.shots[s].exposures_secs.iter().map(move |_| s)).collect();
    for (k, photograph) in photographs.iter().enumerate() {
        for (name, read) in settings {
            let (Some(expected), Some(found)) = (read(first), read(photograph)) else { continue };
            if expected != found {
                let shot = shots.get(k).map_or(String::new(), |&s| plan.shots[s].name.clone());
                let expected = format!("{name} {expected} as in the first photograph");
                return Err(Error::DoesNotFit { path: photograph.path.clone(), shot, expected, found });
            }
        }
    }
    Ok(())
}

fn time(secs: f64) -> String {
    if secs < 0.3 { format!("1/{:.0} s", 1.0 / secs) } else { format!("{} s", (secs * 100.0).round() / 100.0) }
}
