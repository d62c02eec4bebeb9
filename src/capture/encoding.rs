//! What a file says of how its code values encode light.

use std::path::Path;

/// What a PNG file says of its code values, for people; `None` for a file of another format, or one that says nothing.
/// Converters write it without thinking: it is a reason to look, and no proof.
pub(crate) fn stated_encoding(path: &Path) -> Option<String> {
    let file = std::io::BufReader::new(crate::files::open(path).ok()?);
    let reader = super::rows::png_decoder(file).ok()??.read_info().ok()?;
    let info = reader.info();
    match (info.srgb, info.gama_chunk.or(info.source_gamma)) {
        (Some(_), _) => Some("sRGB".into()),
        (None, Some(gamma)) => {
            let gamma = gamma.into_value();
            (gamma != 1.0).then(|| format!("gamma 1/{:.2}", 1.0 / gamma))
        }
        (None, None) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_png_says_how_it_is_encoded_in_its_head() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let write = |say: &dyn Fn(&mut png::Encoder<'_, std::fs::File>)| {
            let mut encoder = png::Encoder::new(std::fs::File::create(&path).unwrap(), 2, 1);
            encoder.set_color(png::ColorType::Grayscale);
            say(&mut encoder);
            encoder.write_header().unwrap().write_image_data(&[1, 2]).unwrap();
        };
        write(&|_| ());
        assert_eq!(stated_encoding(&path), None);
        write(&|e| e.set_source_srgb(png::SrgbRenderingIntent::Perceptual));
        assert_eq!(stated_encoding(&path).as_deref(), Some("sRGB"));
        write(&|e| e.set_source_gamma(png::ScaledFloat::new(0.5)));
        assert_eq!(stated_encoding(&path).as_deref(), Some("gamma 1/2.00"));
        write(&|e| e.set_source_gamma(png::ScaledFloat::new(1.0)));
        assert_eq!(stated_encoding(&path), None);
        assert_eq!(stated_encoding(&dir.path().join("none.png")), None);
    }
}
