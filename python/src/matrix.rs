//! Matrix stores.

use crate::commands::{text, told};
use crate::errors::{raised, refused};
use crate::work::{Report, run};
use acquire::transport::MatrixReader;
use acquire::transport::arrays::{ArrayOf, ArraysOptions, MatrixArrays, import_arrays};
use numpy::{PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods, ToPyArray};
use pyo3::prelude::*;
use std::borrow::Cow;
use std::path::PathBuf;

type Array<'py, T> = Bound<'py, PyArrayDyn<T>>;
type Rows<'py> = (Array<'py, f32>, Array<'py, f32>, Array<'py, u8>);
type Places<'py> = (Array<'py, f64>, Array<'py, f64>, Array<'py, i64>);

/// A matrix that is open.
#[pyclass(frozen, module = "acquire._acquire")]
pub(crate) struct NativeMatrix {
    reader: MatrixReader,
}

#[pymethods]
impl NativeMatrix {
    #[staticmethod]
    fn open(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        py.detach(|| MatrixReader::open(&path)).map(|reader| Self { reader }).map_err(raised)
    }

    /// Points, window, pitches, shots, findings, provenance as JSON.
    fn header(&self) -> PyResult<String> {
        let h = self.reader.header();
        let mut object = serde_json::to_value(h).map_err(acquire::Error::internal).map_err(raised)?;
        object["points"] = serde_json::json!(h.points);
        object["window"] = serde_json::json!(h.window);
        object["channels"] = serde_json::json!(self.reader.channels());
        object["findings"] =
            serde_json::Value::Array(crate::commands::findings(h.warnings.iter().cloned()).map_err(raised)?);
        text(&object)
    }

    /// Places of lit points, mm, (n, 2), their standard deviations, (n,), and their shots, (n,), −1 for none.
    fn places<'py>(&self, py: Python<'py>) -> Places<'py> {
        let h = self.reader.header();
        let shot: Vec<i64> = h.shot_of.iter().map(|s| s.map_or(-1, |s| s as i64)).collect();
        let shaped = |values: &[f64], shape: &[usize]| values.to_pyarray(py).reshape(shape.to_vec());
        let lit = shaped(h.lit_mm.as_flattened(), &[h.rows(), 2]);
        (
            lit.unwrap_or_else(|_| PyArrayDyn::zeros(py, vec![0, 2], false)),
            h.position_sd_mm.to_pyarray(py).to_dyn().clone(),
            shot.to_pyarray(py).to_dyn().clone(),
        )
    }

    /// Rows from `start` to before `stop`: response, variance, validity, (n, dy, dx, 3) each.
    fn read<'py>(&self, py: Python<'py>, start: usize, stop: usize) -> PyResult<Rows<'py>> {
        let h = self.reader.header();
        if start > stop || stop > h.rows() {
            return Err(refused(format_args!(
                "rows: expected a range within 0 to {}, found {start} to {stop}",
                h.rows()
            )));
        }
        let block = py.detach(|| self.reader.read(start..stop)).map_err(raised)?;
        let shape = vec![stop - start, h.window[1], h.window[0], 3];
        let of = |values: Vec<f32>| numpy::PyArray1::from_vec(py, values).reshape(shape.clone());
        Ok((
            of(block.response)?,
            of(block.variance)?,
            numpy::PyArray1::from_vec(py, block.valid).reshape(shape.clone())?,
        ))
    }
}

fn array<'a, T: numpy::Element + Clone>(given: &'a PyReadonlyArrayDyn<'_, T>) -> PyResult<ArrayOf<'a, T>> {
    let values = given.as_slice().map_err(|_| refused("an array: expected one in C order, found another"))?;
    Ok(ArrayOf { shape: given.shape().to_vec(), values: Cow::Borrowed(values) })
}

/// Writes a store from arrays in C order.
#[pyfunction]
#[pyo3(signature = (path, response, variance, valid, x_i_mm, y_i_mm, position_sd_mm, pitch_mm, lit_pitch_mm, points, window, full, force, report))]
#[allow(clippy::too_many_arguments, reason = "keywords of the Python function")]
pub(crate) fn write_matrix(
    py: Python<'_>,
    path: PathBuf,
    response: PyReadonlyArrayDyn<'_, f32>,
    variance: Option<PyReadonlyArrayDyn<'_, f32>>,
    valid: Option<PyReadonlyArrayDyn<'_, u8>>,
    x_i_mm: Option<PyReadonlyArrayDyn<'_, f64>>,
    y_i_mm: Option<PyReadonlyArrayDyn<'_, f64>>,
    position_sd_mm: Option<PyReadonlyArrayDyn<'_, f64>>,
    pitch_mm: Option<f64>,
    lit_pitch_mm: Option<[f64; 2]>,
    points: Option<[usize; 2]>,
    window: Option<[usize; 2]>,
    full: bool,
    force: bool,
    report: Report<'_>,
) -> PyResult<String> {
    acquire::cli::check_matrix_output::<PathBuf>("path", &path, &[], force).map_err(raised)?;
    let arrays = MatrixArrays {
        name: path.clone(),
        response: array(&response)?,
        variance: variance.as_ref().map(array).transpose()?,
        valid: valid.as_ref().map(array).transpose()?,
        x_i_mm: x_i_mm.as_ref().map(array).transpose()?,
        y_i_mm: y_i_mm.as_ref().map(array).transpose()?,
        position_sd_mm: position_sd_mm.as_ref().map(array).transpose()?,
        pitch_mm: None,
        lit_pitch_mm: None,
    };
    let source = "acquire.write_matrix".to_owned();
    let options = ArraysOptions { pitch_mm, lit_pitch_mm, points, window, full, source };
    run(py, report, |progress| told(&import_arrays(&arrays, &options, &path, progress)?))
}
