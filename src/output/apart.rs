//! Inputs and outputs lie apart.

use crate::files::is_url;
use crate::{Error, Result};
use std::path::{Component, Path, PathBuf};

/// Refuses an output that is one of `inputs`, lies in one, or has one in it. `setting` is the option that names the
/// output.
///
/// # Errors
/// [`Error::Setting`], [`Error::Io`].
pub(crate) fn check_apart<P: AsRef<Path>>(setting: &'static str, out: &Path, inputs: &[P]) -> Result<()> {
    if is_url(out) {
        return inputs.iter().try_for_each(|input| refuse_within(setting, out, input.as_ref(), out, input.as_ref()));
    }
    let place = real(out).map_err(Error::io("create", out))?;
    for input in inputs {
        let input = input.as_ref();
        let Ok(there) = input.canonicalize() else { continue };
        refuse_within(setting, out, input, &place, &there)?;
    }
    Ok(())
}

/// `place` and `there` are where `out` and `input` lead.
fn refuse_within(setting: &'static str, out: &Path, input: &Path, place: &Path, there: &Path) -> Result<()> {
    let how = match (place.starts_with(there), there.starts_with(place)) {
        (true, true) => "is",
        (true, false) => "lies in",
        (false, true) => "holds",
        _ => return Ok(()),
    };
    let found = format!("{}, which {how} the input {}", out.display(), input.display());
    Err(Error::Setting { setting, expected: "a place apart from the inputs".into(), found })
}

/// Where a path leads, of which the last parts may not be there yet.
fn real(path: &Path) -> std::io::Result<PathBuf> {
    let path = std::path::absolute(path)?;
    let there = path.ancestors().find_map(|a| Some((a, a.canonicalize().ok()?)));
    let Some((ancestor, mut real)) = there else { return Ok(path) };
    for part in path.strip_prefix(ancestor).unwrap_or(Path::new("")).components() {
        match part {
            Component::ParentDir => drop(real.pop()),
            part => real.push(part),
        }
    }
    Ok(real)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_output_that_is_an_input_or_lies_in_one_or_holds_one_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir_all(at("lab/DCIM/100")).unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink(at("lab"), at("link")).unwrap();
        let inputs = [at("lab/DCIM"), at("not there")];
        let refused = |name: &str| check_apart("out", &at(name), &inputs).is_err();
        for name in ["lab", "lab/DCIM", "lab/DCIM/100", "lab/DCIM/new/deep", "", "new/../lab", "lab/DCIM/100/.."] {
            assert!(refused(name), "{name}");
        }
        #[cfg(unix)]
        assert!(refused("link") && refused("link/DCIM/new"));
        for name in ["lab/DCIM-2", "lab/new", "new", "DCIM"] {
            assert!(!refused(name), "{name}");
        }
    }
}
