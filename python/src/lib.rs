//! The part of the Python module `acquire` that is not Python: arrays go in and out as NumPy's, all else as text
//! (paths, options as they are typed, JSON). `python/acquire/` is what people import; it has the documentation, the
//! types and the warnings.

mod commands;
mod errors;
mod material;
mod matrix;
mod work;

use pyo3::prelude::*;

#[pymodule]
fn _acquire(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("version", env!("CARGO_PKG_VERSION"))?;
    m.add("opencv", cfg!(feature = "opencv"))?;
    m.add_class::<material::NativeMaterial>()?;
    m.add_class::<matrix::NativeMatrix>()?;
    m.add_function(wrap_pyfunction!(matrix::write_matrix, m)?)?;
    m.add_function(wrap_pyfunction!(commands::factor, m)?)?;
    m.add_function(wrap_pyfunction!(commands::factor_by_tasks, m)?)?;
    m.add_function(wrap_pyfunction!(commands::factor_part, m)?)?;
    m.add_function(wrap_pyfunction!(commands::evaluate, m)?)?;
    m.add_function(wrap_pyfunction!(commands::simulate, m)?)?;
    m.add_function(wrap_pyfunction!(commands::build_matrix, m)?)?;
    m.add_function(wrap_pyfunction!(commands::plan, m)?)?;
    m.add_function(wrap_pyfunction!(commands::prepare, m)?)?;
    m.add_function(wrap_pyfunction!(commands::extract, m)?)?;
    m.add_function(wrap_pyfunction!(commands::assemble, m)?)?;
    m.add_function(wrap_pyfunction!(commands::import_matrix, m)?)?;
    Ok(())
}
