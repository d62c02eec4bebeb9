//! What is written of a warning is read by other programs, and by later versions of this one.

use super::samples::written;
use super::*;

#[test]
fn a_warning_is_written_as_its_name_and_figures_whatever_its_stage() {
    for (warning, json) in written() {
        assert_eq!(serde_json::to_string(&warning).unwrap(), json);
    }
}

#[test]
fn every_finding_of_the_catalogue_has_a_sample_here_and_its_name_is_the_one_that_is_written() {
    let samples = written();
    for (warning, json) in &samples {
        let object: serde_json::Value = serde_json::from_str(json).unwrap();
        assert_eq!(object["warning"], warning.id());
    }
    let sampled: std::collections::BTreeSet<_> = samples.iter().map(|(warning, _)| warning.id()).collect();
    let ids = Warning::ids();
    assert_eq!(sampled, ids.iter().copied().collect(), "ids come from an exhaustive match: a variant lacks its sample");
    assert_eq!(sampled.len(), ids.len(), "two stages use one name");
}

#[test]
fn a_record_says_what_the_warning_says_and_survives_being_written() {
    for (warning, _) in written() {
        let record = warning.record();
        assert_eq!((record.id.as_str(), &record.seen), (warning.id(), &warning.to_string()));
        let json = serde_json::to_string(&record).unwrap();
        assert_eq!(serde_json::from_str::<FindingRecord>(&json).unwrap(), record);
        let stops = record.severity == Severity::Error;
        assert_eq!(stops, record.done == Done::Refused, "{record:?}");
        let refused = record.refused();
        assert_eq!((refused.severity, refused.done), (Severity::Error, Done::Refused));
        let object = warning.json().unwrap();
        assert!(object["figures"].is_object() && object["figures"].get("warning").is_none(), "{object}");
    }
}

#[test]
fn severity_follows_the_figures() {
    let dark = |share| Warning::from(CheckWarning::Dark { shot: "s".into(), share }).severity();
    // Between half and nineteen twentieths it is worth knowing.
    assert_eq!((dark(0.94), dark(0.96)), (Severity::Note, Severity::Warning));
}

/// A line of a table of `docs/findings.md` that begins with a name in code.
fn listed(line: &str) -> Option<(&str, Vec<&str>)> {
    let cells: Vec<&str> = line.strip_prefix("| ")?.strip_suffix(" |")?.split(" | ").map(str::trim).collect();
    let id = cells.first()?.strip_prefix('`')?.strip_suffix('`')?;
    // The table of fields has two.
    (cells.len() > 2).then(|| (id, cells[1..].to_vec()))
}

#[test]
fn the_page_of_findings_lists_the_catalogue_and_nothing_else() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/findings.md")).unwrap();
    let listed: Vec<_> = page.lines().filter_map(listed).collect();
    let names: Vec<&str> = listed.iter().map(|(id, _)| *id).collect();
    let mut sorted = (names.clone(), Warning::ids());
    sorted.0.sort_unstable();
    sorted.1.sort_unstable();
    assert_eq!(sorted.0, sorted.1);
    for (id, cells) in listed {
        assert!(cells.len() == 5 && cells.iter().all(|c| !c.is_empty()), "{id}: {cells:?}");
    }
}

#[test]
fn findings_of_a_version_that_knew_fewer_figures_are_read() {
    let read = |json: &str| serde_json::from_str::<Warning>(json).unwrap();
    let old = read(r#"{"warning":"damaged-exif","file":"c.jpg","reason":"cut"}"#);
    assert_eq!(old, CaptureWarning::DamagedExif { file: "c.jpg".into(), reason: "cut".into(), photographs: 0 }.into());
    assert_eq!(old.to_string(), "c.jpg: EXIF is damaged and was read in part: cut");
    assert_eq!(
        read(r#"{"warning":"exposure-disagrees","file":"a","used_secs":0.1,"other_secs":0.2,"other":"EXIF"}"#).id(),
        "exposure-disagrees"
    );
}

#[test]
fn an_unknown_warning_is_refused_in_words() {
    let refused = serde_json::from_str::<Warning>(r#"{"warning":"moon-too-bright","rows":1}"#).unwrap_err();
    assert!(refused.to_string().starts_with("a warning that this version of acquire knows"), "{refused}");
}

#[test]
fn numbers_of_things_agree_with_their_nouns() {
    let said = |warning: Warning| warning.to_string();
    let saturated = |samples, shots| ResponseWarning::SaturatedSamples { first: "lattice-0001".into(), shots, samples };
    let expected = "every exposure saturates in 1 sample of 1 shot (first: \"lattice-0001\"); treated as unmeasured";
    assert_eq!(said(saturated(1, 1).into()), expected);
    let expected = "every exposure saturates in 7 samples of 2 shots (first: \"lattice-0001\"); treated as unmeasured";
    assert_eq!(said(saturated(7, 2).into()), expected);
    let limited = FactorWarning::ShiftLimited { rows: 1, limit: 4 };
    assert_eq!(
        said(limited.into()),
        "in 1 row the peak is more than 4 samples from the lit point; the shift is limited to 4 samples"
    );
}
