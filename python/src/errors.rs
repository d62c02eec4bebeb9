//! Errors of the library as exceptions of `acquire._errors`.

use pyo3::prelude::*;

/// The exception that an error of the library is: `InputError`, or `InternalError` for a fault of the program's own.
pub(crate) fn raised(error: impl Into<acquire::Error>) -> PyErr {
    let error = error.into();
    let name = if error.is_internal() { "InternalError" } else { "InputError" };
    // The variant's name: what a program tells errors apart by.
    let kind = format!("{error:?}");
    let kind = kind.split([' ', '{', '(']).next().unwrap_or_default();
    let text: Vec<String> = error.to_string().split_whitespace().map(str::to_owned).collect();
    let hint = match error {
        acquire::Error::NotEmpty { .. } | acquire::Error::Exists { .. } => " (force=True replaces an earlier output)",
        _ => "",
    };
    exception(name, &(text.join(" ") + hint), kind)
}

/// An `InputError` with these words.
pub(crate) fn refused(text: impl std::fmt::Display) -> PyErr {
    exception("InputError", &text.to_string(), "Setting")
}

/// An `InternalError` with these words.
pub(crate) fn internal(text: impl std::fmt::Display) -> PyErr {
    exception("InternalError", &text.to_string(), "Internal")
}

fn exception(name: &str, text: &str, kind: &str) -> PyErr {
    Python::attach(|py| {
        let made = py.import("acquire._errors").and_then(|module| module.getattr(name)?.call1((text, kind)));
        made.map_or_else(|e| e, PyErr::from_value)
    })
}
