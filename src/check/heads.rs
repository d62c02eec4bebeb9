//! What files, their heads and EXIF tell: nothing is decoded.

use crate::capture::{CameraSettings, Manifest, Photograph, Rig, Taken};
use crate::{CheckWarning, Error};
use rayon::prelude::*;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// One photograph's file, as far as it can be told without decoding.
pub(super) struct Head {
    pub taken: Taken,
    /// Size of the file; `None` for a file that is missing.
    pub bytes: Option<u64>,
    /// What is wrong with it.
    pub finding: Option<CheckWarning>,
}

/// The heads of all photographs, in the order of `capture.toml`.
pub(super) fn read(dir: &Path, manifest: &Manifest, rig: &Rig) -> Vec<Head> {
    let entries = manifest.shots.iter().enumerate().flat_map(|(s, shot)| shot.photographs.iter().map(move |p| (s, p)));
    let entries: Vec<_> = entries.collect();
    entries
        .into_par_iter()
        .map(|(shot, entry)| {
            let path = dir.join(&entry.file);
            let name = &manifest.shots[shot].name;
            let photograph = Photograph::new(&path, name, 0.0);
            let settings = CameraSettings::read(&path).ok().flatten();
            let exposure_secs = entry.exposure_secs.or(settings.as_ref().and_then(|s| s.exposure_secs));
            let mut finding = look(&photograph, &entry.file, rig.camera.size_px);
            if finding.is_none() && exposure_secs.is_none() {
                finding = Some(CheckWarning::NoExposure { file: entry.file.clone() });
            }
            let bytes = crate::files::state(&path).ok().map(|state| state.bytes);
            Head { taken: Taken { shot, file: entry.file.clone(), exposure_secs, settings }, bytes, finding }
        })
        .collect()
}

fn look(photograph: &Photograph, file: &str, expected_px: [usize; 2]) -> Option<CheckWarning> {
    let (file, shot) = (file.to_owned(), photograph.shot.clone());
    match photograph.size_px() {
        Err(Error::MissingPhotograph { .. }) => Some(CheckWarning::MissingPhotograph { file, shot }),
        Err(Error::BrokenPhotograph { reason, .. }) => Some(CheckWarning::BrokenPhotograph { file, shot, reason }),
        Err(e) => Some(CheckWarning::BrokenPhotograph { file, shot, reason: e.to_string() }),
        Ok(found_px) if found_px != expected_px => Some(CheckWarning::WrongSize { file, expected_px, found_px }),
        Ok(_) => {
            let reason = cut_short(&photograph.path).err()?;
            Some(CheckWarning::BrokenPhotograph { file, shot, reason })
        }
    }
}

/// Refuses a PNG, JPEG or TIFF that lacks its end, as a copy that was stopped does. Other formats pass, and damage in
/// the middle too.
fn cut_short(path: &Path) -> Result<(), String> {
    let say = |e: std::io::Error| e.to_string();
    let mut file = crate::files::open(path).map_err(say)?;
    let mut start = [0u8; 8];
    file.read_exact(&mut start).map_err(say)?;
    let short = Err("the file ends before the image does".to_owned());
    let mut end = [0u8; 12];
    if start == *b"\x89PNG\r\n\x1a\n" {
        let whole = file.seek(SeekFrom::End(-12)).and_then(|_| file.read_exact(&mut end)).is_ok();
        // Bytes after the last chunk are permitted: then only decoding tells.
        return if whole && (end[4..8] == *b"IEND" || contains_end_chunk(&mut file)) { Ok(()) } else { short };
    }
    if start.starts_with(b"II*\0") || start.starts_with(b"MM\0*") {
        let bytes = file.len().map_err(say)?;
        file.seek(SeekFrom::Start(0)).map_err(say)?;
        return if tiff_end(file).is_some_and(|end| end > bytes) { short } else { Ok(()) };
    }
    if start.starts_with(&[0xff, 0xd8]) {
        file.seek(SeekFrom::End(-2)).and_then(|_| file.read_exact(&mut end[..2])).map_err(say)?;
        // Compressed data never hold the end marker; anything after it makes a whole reading necessary.
        if end[..2] != [0xff, 0xd9] {
            return crate::capture::check_jpeg_end(&crate::files::read(path).map_err(say)?);
        }
    }
    Ok(())
}

/// Where the last strip or tile of a TIFF's first image ends; `None` when it does not say.
fn tiff_end(file: crate::files::File) -> Option<u64> {
    use tiff::tags::Tag;
    let mut decoder = tiff::decoder::Decoder::new(std::io::BufReader::new(file)).ok()?;
    let mut read = |tag| decoder.find_tag_unsigned_vec::<u64>(tag).ok().flatten();
    let (offsets, counts) = match read(Tag::StripOffsets) {
        Some(offsets) => (offsets, read(Tag::StripByteCounts)?),
        None => (read(Tag::TileOffsets)?, read(Tag::TileByteCounts)?),
    };
    offsets.iter().zip(counts).map(|(o, n)| o.saturating_add(n)).max()
}

fn contains_end_chunk(file: &mut crate::files::File) -> bool {
    let mut all = Vec::new();
    let read = file.seek(SeekFrom::Start(0)).and_then(|_| file.read_to_end(&mut all));
    // With its check sum behind it.
    read.is_ok() && all.windows(12).any(|w| w.starts_with(b"\0\0\0\0IEND"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_lack_their_end_are_cut_short_whatever_their_format() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("photograph");
        let pixels = image::RgbImage::from_fn(40, 30, |x, y| image::Rgb([x as u8 * 6, y as u8 * 8, 77]));
        let encoded = |format| {
            let mut bytes = std::io::Cursor::new(Vec::new());
            pixels.write_to(&mut bytes, format).unwrap();
            bytes.into_inner()
        };
        let mut tiff = std::io::Cursor::new(Vec::new());
        let mut encoder = tiff::encoder::TiffEncoder::new(&mut tiff).unwrap();
        let codes: Vec<u16> = pixels.as_raw().iter().map(|&v| u16::from(v) * 257).collect();
        encoder.write_image::<tiff::encoder::colortype::RGB16>(40, 30, &codes).unwrap();
        // The writer puts the directory behind the strips: as cameras do not.
        let whole = [encoded(image::ImageFormat::Png), encoded(image::ImageFormat::Jpeg)];
        for bytes in &whole {
            std::fs::write(&path, bytes).unwrap();
            assert_eq!(cut_short(&path), Ok(()));
            // A camera's trailer is no harm.
            std::fs::write(&path, [&bytes[..], b"trailer"].concat()).unwrap();
            assert_eq!(cut_short(&path), Ok(()));
            for cut in [1, 12, bytes.len() / 2] {
                std::fs::write(&path, &bytes[..bytes.len() - cut]).unwrap();
                assert!(cut_short(&path).is_err(), "{cut} bytes");
            }
        }
        let tiff = directory_first(&tiff.into_inner());
        std::fs::write(&path, &tiff).unwrap();
        assert_eq!(cut_short(&path), Ok(()));
        std::fs::write(&path, &tiff[..tiff.len() - 1]).unwrap();
        assert!(cut_short(&path).is_err());
    }

    /// A little-endian TIFF of one strip with its strip moved behind everything else.
    fn directory_first(tiff: &[u8]) -> Vec<u8> {
        let u16_at = |k: usize| u16::from_le_bytes([tiff[k], tiff[k + 1]]);
        let u32_at = |k: usize| u32::from_le_bytes([tiff[k], tiff[k + 1], tiff[k + 2], tiff[k + 3]]);
        let directory = u32_at(4) as usize;
        let entry =
            |tag: u16| (0..usize::from(u16_at(directory))).map(|n| directory + 2 + 12 * n).find(|&k| u16_at(k) == tag);
        let (offsets, counts) = (entry(273).unwrap(), entry(279).unwrap());
        assert_eq!(u32_at(offsets + 4), 1, "one strip");
        let (from, count) = (u32_at(offsets + 8) as usize, u32_at(counts + 8) as usize);
        let mut moved = tiff.to_vec();
        moved[offsets + 8..offsets + 12].copy_from_slice(&(tiff.len() as u32).to_le_bytes());
        moved.extend_from_slice(&tiff[from..from + count]);
        moved
    }
}
