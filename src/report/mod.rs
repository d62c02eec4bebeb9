//! Report: one self-contained page with pictures.
