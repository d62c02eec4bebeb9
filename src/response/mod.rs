//! Extract: for each lit point the window of responses, with variance.
