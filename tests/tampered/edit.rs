//! Changes of capture.toml and rig.toml.

use crate::capture::Capture;
use crate::data::Edit;
use toml::Value;

pub(crate) fn apply(capture: &mut Capture, edit: &Edit) {
    let (file, path) = edit.field.split_once('.').expect("capture.FIELD or rig.FIELD");
    let mut table = match file {
        "capture" => &mut capture.manifest,
        "rig" => &mut capture.rig,
        other => panic!("{other}: an edit is of capture or rig"),
    };
    let (tables, name) = path.rsplit_once('.').map_or((None, path), |(tables, name)| (Some(tables), name));
    for part in tables.iter().flat_map(|tables| tables.split('.')) {
        table = table.entry(part).or_insert_with(|| toml::Table::new().into()).as_table_mut().unwrap();
    }
    if edit.remove {
        table.remove(name).unwrap_or_else(|| panic!("{} is not there", edit.field));
    }
    if let Some(value) = &edit.set {
        table.insert(name.to_owned(), value.clone());
    }
    if let Some(add) = &edit.add {
        each_number(&mut table[name], &mut |k, v| v + add[k % add.len()]);
    }
    if let Some(times) = &edit.times {
        each_number(&mut table[name], &mut |k, v| v * times[k % times.len()]);
    }
    if edit.exchange_each {
        table[name].as_array_mut().unwrap().iter_mut().for_each(|each| each.as_array_mut().unwrap().swap(0, 1));
    }
    if edit.exchange {
        table[name].as_array_mut().unwrap().swap(0, 1);
    }
}

/// Changes every number of a value, the k-th of its list; a whole number stays one.
fn each_number(value: &mut Value, change: &mut dyn FnMut(usize, f64) -> f64) {
    fn go(value: &mut Value, k: usize, change: &mut dyn FnMut(usize, f64) -> f64) {
        match value {
            Value::Integer(v) => *v = change(k, *v as f64).round() as i64,
            Value::Float(v) => *v = change(k, *v),
            Value::Array(list) => list.iter_mut().enumerate().for_each(|(k, v)| go(v, k, change)),
            other => panic!("{other} is no number"),
        }
    }
    go(value, 0, change);
}

/// Other grid indices for the dots of these shots: moved around the grid, or counted from its other side along an axis.
pub(crate) fn dots(capture: &mut Capture, shots: &[usize], add: Option<[i64; 2]>, mirror: Option<usize>) {
    let points = capture.manifest["grid"]["points"].as_array().unwrap();
    let points: Vec<i64> = points.iter().map(|n| n.as_integer().unwrap()).collect();
    for &shot in shots {
        for dot in capture.manifest["shots"][shot]["dots"].as_array_mut().unwrap() {
            for axis in 0..2 {
                let index = dot[axis].as_integer().unwrap() + add.map_or(0, |add| add[axis]);
                let index = index.rem_euclid(points[axis]);
                dot[axis] = Value::Integer(if mirror == Some(axis) { points[axis] - 1 - index } else { index });
            }
        }
    }
}
