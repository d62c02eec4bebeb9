use super::super::content::Content;
use super::super::test_matrices::{StoredMatrix, stored};
use super::super::{FactorOptions, Goal, factor_and_store};
use super::*;
use crate::material::{Model, Precision};
use crate::transport::Row;
use proptest::prelude::*;
use std::sync::OnceLock;

const POINTS: [usize; 2] = [7, 9];
const WINDOW: [usize; 2] = [9, 7];
const ROWS: usize = 63;

/// Rows of another colour and shape each, of which some have their peak beside the lit point and some have gaps; row 40
/// has nothing.
fn response(i: usize, e: usize, c: usize) -> f64 {
    let (x, y) = ((e % 9) as f64 - 4.0, (e / 9) as f64 - 3.0);
    let (at, s) = (i as f64, if i.is_multiple_of(5) { 1.0 } else { 0.0 });
    let d2 = (x - s).powi(2) + y * y;
    let tail = 0.3 * (1.0 + (0.7 * at + x).sin() * (0.4 * y + c as f64).cos());
    let light = (1.0 + 0.4 * (0.3 * at).sin()) * (-d2 / (4.0 + c as f64)).exp() + 0.05 * tail;
    if i == 40 { 0.0 } else { light * (1.0 + 0.3 * c as f64) }
}

fn valid(i: usize, e: usize) -> bool {
    !(i % 4 == 1 && (e + i).is_multiple_of(11) || i == 17 && e < 9)
}

fn matrix() -> &'static StoredMatrix {
    static MADE: OnceLock<StoredMatrix> = OnceLock::new();
    MADE.get_or_init(|| {
        let entries = || (0..63).flat_map(|e| (0..3).map(move |c| (e, c)));
        let row = |i: usize| Row {
            response: entries().map(|(e, c)| if valid(i, e) { response(i, e, c) as f32 } else { 0.0 }).collect(),
            variance: entries().map(|(e, c)| (1e-8 * (1.0 + (e + c + i) as f64)) as f32).collect(),
            valid: entries().map(|(e, _)| valid(i, e)).collect(),
        };
        stored(POINTS, WINDOW, |i| 1e-4 * (i % 3) as f64, row)
    })
}

fn options(model: Model, degree: Option<usize>, maps: Option<bool>) -> FactorOptions {
    let backend = Some(Backend::Gram);
    FactorOptions { model: Some(model), terms: Some(4), degree, maps, backend, ..FactorOptions::default() }
}

const F32: Storage = Storage { precision: Precision::F32, added_error: None };

/// Factors by so many tasks; calls `meanwhile` before each round of them.
fn by_tasks(options: &FactorOptions, storage: &Storage, parts: usize, meanwhile: impl Fn(&Path, usize)) -> Stored {
    let folder = tempfile::tempdir().unwrap();
    let tasks = TaskFolder { path: folder.path().into(), parts: Some(parts) };
    let progress = Progress::silent();
    for round in 0..200 {
        match factor_and_store_by_tasks(&matrix().reader, options, storage, &tasks, &progress) {
            Err(Error::PassDue { missing, of, .. }) => {
                assert_eq!(of, parts);
                meanwhile(folder.path(), round);
                for number in missing.into_iter().flatten() {
                    factor_part(folder.path(), [number, parts], &progress).unwrap();
                }
            }
            made => return made.unwrap(),
        }
    }
    panic!("no end of passes")
}

/// The largest difference of two materials over the largest response.
fn apart(a: &Stored, b: &Stored) -> f64 {
    let (mut most, mut largest) = (0.0_f64, 0.0_f64);
    for i in 0..ROWS {
        for (a, b) in a.factored.material.evaluate_row(i).iter().zip(b.factored.material.evaluate_row(i)) {
            most = most.max(f64::from((a - b).abs()));
            largest = largest.max(f64::from(b.abs()));
        }
    }
    most / largest
}

#[test]
fn a_material_by_tasks_is_that_of_one_process_with_every_model_and_with_maps() {
    let kinds = [
        options(Model::Tucker, Some(3), None),
        options(Model::Joint, None, Some(false)),
        options(Model::Joint, None, Some(true)),
        FactorOptions { terms: None, max_terms: 6, ..options(Model::Joint, None, None) },
        FactorOptions { goal: Goal::Psnr(30.0), terms: None, ..options(Model::Tucker, None, None) },
        FactorOptions { backend: Some(Backend::Randomized), ..options(Model::Joint, None, Some(false)) },
        FactorOptions { profile_power: 0.0, peak_shift: false, ..options(Model::Peers2006, None, None) },
    ];
    for options in kinds {
        let alone = factor_and_store(&matrix().reader, &options, &F32, &Progress::silent()).unwrap();
        let tasks = by_tasks(&options, &F32, 5, |_, _| {});
        let (off, rmse) = (apart(&tasks, &alone), tasks.factored.rel_rmse / alone.factored.rel_rmse - 1.0);
        match options.backend {
            // Products in f32 are of fewer rows at a time: an iteration ends elsewhere within its accuracy.
            Some(Backend::Randomized) => assert!(off < 1e-3 && rmse.abs() < 1e-3, "{options:?}: {off:e}, {rmse:e}"),
            // Sums in f64 in another order; what is stored is f32.
            _ => assert!(off < 1e-6 && rmse.abs() < 1e-6, "{options:?}: {off:e}, {rmse:e}"),
        }
        assert_eq!(tasks.factored.material.shift, alone.factored.material.shift);
        assert!(tasks.factored.material.is_shifted() == options.peak_shift, "rows that are moved");
        // After it come passes and residuals, which rounding may change.
        let why = |made: &Stored| {
            made.factored.choice.split(&format!("; {}", made.factored.backend)).next().map(str::to_owned)
        };
        assert_eq!(why(&tasks), why(&alone));
        assert!(tasks.factored.choice.contains(", by tasks"));
    }
}

#[test]
fn a_coded_material_is_made_by_tasks_too() {
    let options = FactorOptions { goal: Goal::Psnr(34.0), terms: None, ..options(Model::Joint, None, None) };
    let storage = Storage { precision: Precision::Coded, added_error: None };
    let alone = factor_and_store(&matrix().reader, &options, &storage, &Progress::silent()).unwrap();
    let tasks = by_tasks(&options, &storage, 3, |_, _| {});
    let ratio = tasks.bytes as f64 / alone.bytes as f64;
    // A coefficient or two may fall to the other side of a step.
    assert!((ratio - 1.0).abs() < 0.02 && apart(&tasks, &alone) < 0.02, "{ratio}");
}

#[test]
fn killed_late_damaged_and_repeated_tasks_change_no_bit() {
    let options = FactorOptions { backend: None, ..options(Model::Tucker, Some(3), None) };
    let plain = by_tasks(&options, &F32, 4, |_, _| {});
    let troubled = by_tasks(&options, &F32, 4, |folder, round| {
        let progress = Progress::silent();
        let part = folder.join("2-of-4.part");
        match round % 4 {
            // Part 2 of the pass before stays there; part 1 is done twice.
            0 => assert!(!factor_part(folder, [1, 4], &progress).unwrap().was_there),
            1 => std::fs::write(&part, b"acquire found 1\nand no more").unwrap(),
            2 => {
                let done = factor_part(folder, [2, 4], &progress).unwrap();
                assert_eq!((done.was_there, done.rows), (false, [14, 28]));
                assert!(factor_part(folder, [2, 4], &progress).unwrap().was_there);
                let mut bytes = std::fs::read(&part).unwrap();
                let middle = bytes.len() / 2;
                bytes[middle] ^= 1;
                std::fs::write(&part, bytes).unwrap();
            }
            _ => std::fs::write(folder.join(".3-of-4.part.abc123.unfinished"), b"").unwrap(),
        }
    });
    assert_eq!(plain.file, troubled.file);
}

#[test]
fn what_tasks_cannot_do_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let (reader, progress) = (&matrix().reader, Progress::silent());
    let refused = |options: FactorOptions, parts| {
        let tasks = TaskFolder { path: folder.path().into(), parts: Some(parts) };
        match factor_and_store_by_tasks(reader, &options, &F32, &tasks, &progress) {
            Err(Error::Setting { setting, .. }) => setting,
            other => panic!("{other:?}"),
        }
    };
    let base = || options(Model::Joint, None, None);
    assert_eq!(refused(FactorOptions { backend: Some(Backend::Full), ..base() }, 2), "backend");
    assert_eq!(refused(FactorOptions { memory_bytes: Some(1 << 30), ..base() }, 2), "memory");
    assert_eq!(refused(FactorOptions { terms: Some(0), ..base() }, 2), "terms");
    assert_eq!((refused(base(), 0), refused(base(), 10)), ("parts", "parts"), "a line of lit points is a chunk: 9");
    assert!(matches!(factor_part(folder.path(), [1, 2], &progress), Err(Error::Io { .. })), "no pass is due");
    let tasks = TaskFolder { path: folder.path().into(), parts: Some(2) };
    assert!(factor_and_store_by_tasks(reader, &base(), &F32, &tasks, &progress).is_err());
    for part in [[0, 2], [3, 2], [1, 3]] {
        let found = factor_part(folder.path(), part, &progress);
        assert!(matches!(found, Err(Error::Setting { setting: "part", .. })), "{part:?}: {found:?}");
    }
    std::fs::write(folder.path().join("next.pass"), b"acquire pass 1\n\0 cut").unwrap();
    assert!(matches!(factor_part(folder.path(), [1, 2], &progress), Err(Error::Field { .. })));
}

#[test]
fn an_accuracy_that_needs_all_rows_in_one_place_is_refused_for_wide_windows_alone() {
    use super::super::backend::choose_for_tasks;
    assert_eq!(choose_for_tasks(50_000, 1e-6).unwrap(), Backend::Randomized);
    assert_eq!(choose_for_tasks(4500, 1e-9).unwrap(), Backend::Gram);
    assert!(matches!(choose_for_tasks(4501, 1e-9), Err(Error::Setting { setting: "accuracy", .. })));
}

/// The passes of a factorization whose rows are moved, weighed, filled and divided by maps.
fn passes() -> &'static Vec<Vec<u8>> {
    static KEPT: OnceLock<Vec<Vec<u8>>> = OnceLock::new();
    KEPT.get_or_init(|| {
        let kept = std::sync::Mutex::new(Vec::new());
        let keep = |folder: &Path, _| kept.lock().unwrap().push(std::fs::read(folder.join("next.pass")).unwrap());
        by_tasks(&FactorOptions { backend: None, ..options(Model::Joint, None, Some(true)) }, &F32, 3, keep);
        by_tasks(&options(Model::Tucker, Some(3), None), &F32, 3, keep);
        kept.into_inner().unwrap()
    })
}

/// What a pass finds of some rows, and what rows are to it.
fn go_over(pass: &[u8], range: std::ops::Range<usize>) -> (Found, Content) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("next.pass");
    std::fs::write(&path, pass).unwrap();
    let due: PassFile = TaskFile::read(&path, PASS).unwrap().unwrap().value().unwrap();
    let content = match &due.pass {
        Pass::Survey { content, .. } => *content,
        _ => Content::Channels,
    };
    (due.pass.go_over(Passes::here(&matrix().reader, &Progress::silent()), range).unwrap(), content)
}

/// Numbers of what a pass has found.
fn numbers_of((found, content): (Found, Content)) -> Vec<f64> {
    match found {
        Found::Sum(sum) => vec![sum],
        Found::Matrix(numbers) | Found::Rows(numbers) => numbers,
        Found::Colors { coefficients, error } => coefficients.into_iter().map(f64::from).chain([error]).collect(),
        Found::Survey { rows, sums } => {
            let reader = &matrix().reader;
            let survey = rows.survey(reader, content, [2, 1]);
            let mut all = super::super::entry_exit::Marginals::new(reader).unwrap();
            sums.into_iter().for_each(|sums| all.join(sums));
            let placements = survey.placements.iter().flat_map(|p| [p.scale, p.shift[0].into(), p.shift[1].into()]);
            let noise = survey.noise.rows.iter().chain(&survey.noise.columns).copied();
            let told = [survey.energy, survey.peak, survey.entries as f64, survey.noise.mean];
            survey.mean.iter().copied().chain(noise).chain(placements).chain(told).chain(all.numbers()).collect()
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    #[test]
    fn what_any_parts_find_makes_what_all_rows_say(mut ends in proptest::collection::vec(0..=ROWS, 0..6), which in 0..1000_usize) {
        let pass = &passes()[which % passes().len()];
        ends.extend([0, ROWS]);
        ends.sort_unstable();
        ends.dedup();
        let mut parts = ends.windows(2).map(|w| go_over(pass, w[0]..w[1]));
        let mut all = parts.next().unwrap();
        parts.for_each(|(part, _)| all.0.join(part).unwrap());
        let (joined, whole) = (numbers_of(all), numbers_of(go_over(pass, 0..ROWS)));
        prop_assert_eq!(joined.len(), whole.len());
        let largest = whole.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        for (a, b) in joined.iter().zip(&whole) {
            // Products of up to 63 rows in f32; all else is f64.
            prop_assert!((a - b).abs() <= 1e-6 * largest, "{} {} of {}", a, b, largest);
        }
    }
}
