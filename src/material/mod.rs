//! Material: evaluate R̂_d, relight, save, export.
