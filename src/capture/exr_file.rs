//! The picture in an OpenEXR file: its channels R, G and B, or Y, wherever they are, in the display window.

use exr::meta::{MetaData, header::Header};
use exr::prelude::*;
use std::io::{BufRead, Cursor, Seek};
use std::result::Result;

/// The largest picture that is decoded, px.
const MOST_PIXELS: usize = 1 << 27;
/// What a section of a DWA block may announce, over the bytes of the pixels that it is of: they are padded to blocks
/// of 8.
const DWA_SLACK: u64 = 4;

/// Columns and rows of the display window, from the head.
///
/// # Errors
/// In words, what is wrong with the file.
pub(super) fn exr_size(head: &MetaData) -> Result<[usize; 2], String> {
    let first = head.headers.first().ok_or("no image in the file")?;
    let window = first.shared_attributes.display_window;
    let size = [window.size.width(), window.size.height()];
    for [w, h] in head.headers.iter().map(|l| [l.layer_size.width(), l.layer_size.height()]).chain([size]) {
        if w.checked_mul(h).is_none_or(|pixels| pixels > MOST_PIXELS) {
            return Err(format!("{w} × {h} px: more than {MOST_PIXELS} are not read"));
        }
    }
    Ok(size)
}

/// Columns, rows, and R G B of each pixel; 0 where the display window has no data. A single Y is repeated.
///
/// # Errors
/// In words, what is wrong with the file, or that nothing tells which of several pictures is meant.
pub(crate) fn decode_exr(
    mut file: impl BufRead + Seek + Send,
    most_pixels: usize,
) -> Result<(usize, usize, Vec<f32>), String> {
    let words = |e: exr::error::Error| e.to_string();
    let head = MetaData::read_from_buffered(&mut file, false).map_err(words)?;
    let [width, height] = exr_size(&head)?;
    if width * height > most_pixels {
        return Err(format!("{width} × {height} px: more than {most_pixels} are not read"));
    }
    let names = channels(&head)?;
    if head.headers.iter().any(|h| is_dwa(h.compression)) {
        file.rewind().map_err(|e| e.to_string())?;
        check_dwa(&mut file)?;
    }
    file.rewind().map_err(|e| e.to_string())?;
    let origin = head.headers[0].shared_attributes.display_window.position;
    let corner = |header: &Header| header.own_attributes.layer_position;
    let holds =
        |header: &&Header| names.iter().all(|name| header.channels.list.iter().any(|c| c.name.eq(name.as_str())));
    let offset = head.headers.iter().find(holds).map_or(Vec2(0, 0), corner) - origin;
    let place = move |at: Vec2<usize>| {
        let [x, y] = [at.x() as i64 + i64::from(offset.0), at.y() as i64 + i64::from(offset.1)];
        let inside = x >= 0 && y >= 0 && x < width as i64 && y < height as i64;
        inside.then(|| 3 * (y as usize * width + x as usize))
    };
    let canvas = move || vec![0.0f32; 3 * width * height];
    let read = read().no_deep_data().largest_resolution_level();
    match names.as_slice() {
        [r, g, b] => {
            let channels = read.specific_channels().required(r.as_str()).required(g.as_str()).required(b.as_str());
            let put = move |pixels: &mut Vec<f32>, at, (r, g, b): (f32, f32, f32)| {
                if let Some(k) = place(at) {
                    pixels[k..k + 3].copy_from_slice(&[r, g, b]);
                }
            };
            let image = channels
                .collect_pixels(move |_, _| canvas(), put)
                .first_valid_layer()
                .all_attributes()
                .from_buffered(file);
            Ok((width, height, image.map_err(words)?.layer_data.channel_data.pixels))
        }
        [y] => {
            let put = move |pixels: &mut Vec<f32>, at, (y,): (f32,)| {
                if let Some(k) = place(at) {
                    pixels[k..k + 3].fill(y);
                }
            };
            let channels = read.specific_channels().required(y.as_str());
            let image = channels
                .collect_pixels(move |_, _| canvas(), put)
                .first_valid_layer()
                .all_attributes()
                .from_buffered(file);
            Ok((width, height, image.map_err(words)?.layer_data.channel_data.pixels))
        }
        _ => Err("no picture in the file".into()),
    }
}

/// [`decode_exr`] of bytes.
///
/// # Errors
/// Those of [`decode_exr`].
pub(crate) fn decode_exr_bytes(bytes: &[u8], most_pixels: usize) -> Result<(usize, usize, Vec<f32>), String> {
    decode_exr(Cursor::new(bytes), most_pixels)
}

/// The channels of the picture: R, G, B without a layer's name, or of the only layer that has them; else Y likewise.
fn channels(head: &MetaData) -> Result<Vec<String>, String> {
    let names = |header: &Header| header.channels.list.iter().map(|c| c.name.to_string()).collect::<Vec<_>>();
    let all: Vec<Vec<String>> = head.headers.iter().map(names).collect();
    for wanted in [&["R", "G", "B"][..], &["Y"]] {
        let mut found: Vec<Vec<String>> = Vec::new();
        for names in &all {
            // What stands before the last name: the layer.
            let layers = names.iter().filter_map(|name| name.strip_suffix(wanted[0]));
            let layers = layers.filter(|layer| layer.is_empty() || layer.ends_with('.'));
            let of = |layer: &str| wanted.iter().map(|w| format!("{layer}{w}")).collect::<Vec<_>>();
            let chroma = |layer: &str| names.contains(&format!("{layer}RY")) || names.contains(&format!("{layer}BY"));
            found.extend(
                layers.filter(|layer| !chroma(layer)).map(of).filter(|of| of.iter().all(|c| names.contains(c))),
            );
        }
        if let Some(plain) = found.iter().find(|of| of[0] == wanted[0]) {
            return Ok(plain.clone());
        }
        match found.as_slice() {
            [] => {}
            [only] => return Ok(only.clone()),
            [first, second, ..] => {
                return Err(format!(
                    "several pictures in layers ({}, {}, …): which is meant is not known",
                    first[0], second[0]
                ));
            }
        }
    }
    let found: Vec<String> = all.into_iter().flatten().take(8).collect();
    Err(format!("expected channels R, G, B or Y, found {}", found.join(", ")))
}

fn is_dwa(compression: Compression) -> bool {
    matches!(compression, Compression::DWAA(_) | Compression::DWAB(_))
}

/// Refuses DWA blocks that announce more than their pixels take: the decoder sets memory aside for what they announce.
fn check_dwa(file: &mut (impl BufRead + Seek)) -> Result<(), String> {
    let words = |e: exr::error::Error| e.to_string();
    let reader = exr::block::read(file, false).map_err(words)?;
    let headers = reader.headers().to_vec();
    // By the table of offsets, as the decoder does: chunks that follow each other may be others.
    for chunk in reader.filter_chunks(false, |_, _, _| true).map_err(words)? {
        let chunk = chunk.map_err(words)?;
        let Some(header) = headers.get(chunk.layer_index).filter(|h| is_dwa(h.compression)) else { continue };
        let bytes = match &chunk.compressed_block {
            exr::block::chunk::CompressedBlock::ScanLine(block) => &block.compressed_pixels_le,
            exr::block::chunk::CompressedBlock::Tile(block) => &block.compressed_pixels_le,
            _ => return Err("deep data are not read".into()),
        };
        let [width, rows] = match header.blocks {
            exr::meta::BlockDescription::Tiles(tiles) => [tiles.tile_size.width(), tiles.tile_size.height()],
            exr::meta::BlockDescription::ScanLines => {
                [header.layer_size.width(), header.compression.scan_lines_per_block()]
            }
        };
        let pixels = (width.next_multiple_of(8) * rows.next_multiple_of(8)) as u64;
        let most = DWA_SLACK * pixels * 4 * header.channels.list.len() as u64;
        // Version, then sizes: of the unknown, its compressed, AC, DC and RLE compressed, RLE inflated and raw, AC and
        // DC counts.
        let announced = bytes.as_chunks::<8>().0.iter().map(|b| u64::from_le_bytes(*b)).take(10);
        if let Some(size) = announced.skip(1).find(|size| *size > most) {
            return Err(format!("a DWA block announces {size} of what its pixels have {most} of at the most"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(window: IntegerBounds, layer: Layer<AnyChannels<FlatSamples>>) -> Vec<u8> {
        let mut file = Cursor::new(Vec::new());
        let image = Image::from_layers(ImageAttributes::new(window), vec![layer]);
        image.write().to_buffered(&mut file).unwrap();
        file.into_inner()
    }

    fn layer(channels: &[(&'static str, f32)], size: [usize; 2]) -> Layer<AnyChannels<FlatSamples>> {
        let of = |(name, from): &(&'static str, f32)| {
            AnyChannel::new(*name, FlatSamples::F32((0..size[0] * size[1]).map(|k| from + k as f32).collect()))
        };
        let list: SmallVec<[_; 4]> = channels.iter().map(of).collect();
        Layer::new((size[0], size[1]), LayerAttributes::named("a"), Encoding::FAST_LOSSLESS, AnyChannels::sort(list))
    }

    fn read_of(channels: &[(&'static str, f32)]) -> Result<Vec<f32>, String> {
        decode_exr_bytes(&written(IntegerBounds::from_dimensions((2, 1)), layer(channels, [2, 1])), 1 << 20)
            .map(|(_, _, pixels)| pixels)
    }

    #[test]
    fn the_picture_is_found_in_its_layer_or_in_y() {
        assert_eq!(
            read_of(&[("B", 30.0), ("G", 20.0), ("R", 10.0), ("Z", 9.0)]).unwrap(),
            [10.0, 20.0, 30.0, 11.0, 21.0, 31.0]
        );
        assert_eq!(read_of(&[("irr.B", 3.0), ("irr.G", 2.0), ("irr.R", 1.0)]).unwrap(), [1.0, 2.0, 3.0, 2.0, 3.0, 4.0]);
        assert_eq!(read_of(&[("Y", 5.0)]).unwrap(), [5.0, 5.0, 5.0, 6.0, 6.0, 6.0]);
        assert_eq!(read_of(&[("a.Y", 5.0), ("a.Z", 1.0)]).unwrap()[3], 6.0);
        let two = read_of(&[("a.B", 3.0), ("a.G", 2.0), ("a.R", 1.0), ("b.B", 3.0), ("b.G", 2.0), ("b.R", 1.0)]);
        assert!(two.unwrap_err().contains("several pictures in layers (a.R, b.R"));
        assert!(read_of(&[("A", 1.0), ("Z", 2.0)]).unwrap_err().contains("expected channels R, G, B or Y, found A, Z"));
    }

    #[test]
    fn data_lie_in_the_display_window_where_their_own_window_says() {
        let mut part = layer(&[("Y", 1.0)], [2, 2]);
        part.attributes.layer_position = Vec2(11, 4);
        let window = IntegerBounds::new(Vec2(10, 5), Vec2(4, 2));
        let (w, h, pixels) = decode_exr_bytes(&written(window, part), 1 << 20).unwrap();
        let y: Vec<f32> = pixels.iter().step_by(3).copied().collect();
        // The upper line of the data lies above the window.
        assert_eq!((w, h, y), (4, 2, vec![0.0, 3.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0]));
    }

    #[test]
    fn a_head_that_announces_too_many_pixels_is_refused() {
        let mut bytes = written(IntegerBounds::from_dimensions((2, 2)), layer(&[("Y", 1.0)], [2, 2]));
        assert!(decode_exr_bytes(&bytes, 3).unwrap_err().contains("more than 3"));
        // The data window ends with its largest column and row.
        let at = bytes.windows(12).position(|w| w == b"dataWindow\0b").unwrap() + b"dataWindow\0box2i\0".len() + 4 + 8;
        bytes[at..at + 8].copy_from_slice(&[0xff, 0xff, 0, 0, 0xff, 0xff, 0, 0]);
        assert!(decode_exr_bytes(&bytes, usize::MAX).is_err());
    }
}
