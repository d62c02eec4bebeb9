use super::Context;
use super::values::pair_of;
use crate::material::{Exitance, ImagePlacement, Source, lit_area, parse_light, place_light, relight, write_exitance};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Light the slab with an image and write what leaves it.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire relight slab.safetensors --light spot --out spot.exr
  acquire relight slab.rd.zarr --light window.png --out relit.exr       the measured matrix itself
  acquire relight slab.safetensors --light window.png --extent-mm 6x4 --out e.exr    6 mm wide
  acquire relight slab.safetensors --light window.png --tile 3x2 --out e.exr         side by side
  acquire relight slab.safetensors --light point:3,5 --out point.exr    one lit point")]
pub(super) struct Args {
    /// A material or a matrix.
    #[arg(value_parser = super::things::matrix())]
    source: PathBuf,
    /// Irradiance over the lit area: an image (EXR linear, PNG or JPEG sRGB), or spot, stripes, gradient, uniform,
    /// point:I,J.
    #[arg(long, value_name = "LIGHT")]
    light: String,
    /// Size on the slab of what the image covers, mm: centred on the lit area, along the slab's axes, dark beyond it
    /// [default: the lit area, half a lit pitch around the lit points, along their lattice].
    #[arg(long, value_name = "WxH", value_parser = pair_of::<f64>, allow_negative_numbers = true)]
    extent_mm: Option<[f64; 2]>,
    /// Copies of the image side by side that fill it together. Where copies meet, samples are means over parts of
    /// both, as within the image: a periodic image has no seams.
    #[arg(long, value_name = "NxM", value_parser = pair_of::<usize>, default_value = "1x1")]
    tile: [usize; 2],
    /// The exitance to write, linear OpenEXR; a tone-mapped PNG goes beside it.
    #[arg(long, short, value_name = "FILE.exr")]
    out: PathBuf,
    /// Replace an earlier exitance and its PNG there.
    #[arg(long)]
    force: bool,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let png = args.out.with_extension("png");
    let inputs = [args.source.as_path(), Path::new(&args.light)];
    super::check_output("out", &args.out, &inputs, &["exr"], args.force)?;
    super::check_output("out", &png, &inputs, &["png"], args.force)?;
    let light = parse_light(&args.light)?;
    let source = Source::open(&args.source)?;
    let area = lit_area(&source)?;
    let placement = ImagePlacement { extent_mm: args.extent_mm.map(|size| area.around_middle(size)), tile: args.tile };
    let (light, findings) = place_light(light, &area, &placement)?;
    context.tell(&findings);
    let quadrature = light.quadrature(&area, &source.shape());
    let flux = light.flux(&quadrature)?;
    let images = relight(&source, &quadrature, &[flux], &context.progress)?;
    let Some(exitance) = images.first() else { return Err(Error::internal("no image was made")) };
    write_exitance(exitance, &args.out)?;
    let white = exitance.white();
    write_png(exitance, white, &png)?;
    context.done(format_args!(
        "{}: {} × {} samples; {} shows it with exposure {:.4} (white is an exitance of {white:.4})",
        args.out.display(),
        exitance.canvas.size[0],
        exitance.canvas.size[1],
        png.display(),
        1.0 / white
    ));
    Ok(())
}

fn write_png(exitance: &Exitance, white: f64, path: &Path) -> Result<()> {
    let [width, height] = exitance.canvas.size.map(|s| s as u32);
    let rgb = exitance.tone_mapped(white);
    let Some(image) = image::RgbImage::from_raw(width, height, rgb) else {
        return Err(Error::internal("the image has another size than its samples"));
    };
    crate::material::write_png(&image, path)
}
