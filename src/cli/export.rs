use super::Context;
use crate::Result;

/// (to be written)
#[derive(Debug, clap::Args)]
pub struct Args {}

pub fn run(_args: Args, _context: &Context) -> Result<()> {
    todo!()
}
