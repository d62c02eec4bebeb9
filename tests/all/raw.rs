//! Raw files: the mosaic with its levels, and no preview in its place.
#![cfg(feature = "raw")]

use acquire::capture::{Photograph, Samples};
use std::path::Path;
use tiff::encoder::{Rational, TiffEncoder};
use tiff::tags::Tag;

const WIDTH: usize = 14;
const HEIGHT: usize = 12;
/// Top, left, bottom, right of what sees light.
const ACTIVE: [u32; 4] = [2, 4, 12, 14];
const BLACK: [u16; 4] = [510, 512, 514, 516];
const WHITE: u32 = 15_000;

/// A small DNG as cameras write them: an 8-bit preview first, the mosaic in a SubIFD.
fn write_dng(path: &Path, pattern: [u8; 4], codes: &[u16]) {
    let mut encoder = TiffEncoder::new(std::fs::File::create(path).unwrap()).unwrap();
    let mut raw = encoder.extra_directory().unwrap();
    let offset = raw.write_data(codes).unwrap() as u32;
    let short =
        |raw: &mut tiff::encoder::DirectoryEncoder<'_, _, _>, tag, v: u16| raw.write_tag(Tag::Unknown(tag), v).unwrap();
    let long =
        |raw: &mut tiff::encoder::DirectoryEncoder<'_, _, _>, tag, v: u32| raw.write_tag(Tag::Unknown(tag), v).unwrap();
    long(&mut raw, 254, 0); // NewSubFileType: the picture itself
    long(&mut raw, 256, WIDTH as u32);
    long(&mut raw, 257, HEIGHT as u32);
    short(&mut raw, 258, 16);
    short(&mut raw, 259, 1);
    short(&mut raw, 262, 32_803); // a colour filter array
    long(&mut raw, 273, offset);
    short(&mut raw, 277, 1);
    long(&mut raw, 278, HEIGHT as u32);
    long(&mut raw, 279, 2 * codes.len() as u32);
    raw.write_tag(Tag::Unknown(33_421), &[2u16, 2][..]).unwrap(); // CFARepeatPatternDim
    raw.write_tag(Tag::Unknown(33_422), &pattern[..]).unwrap();
    raw.write_tag(Tag::Unknown(50_713), &[2u16, 2][..]).unwrap(); // BlackLevelRepeatDim
    raw.write_tag(Tag::Unknown(50_714), &BLACK[..]).unwrap();
    long(&mut raw, 50_717, WHITE);
    raw.write_tag(Tag::Unknown(50_829), &ACTIVE[..]).unwrap();
    let at = raw.finish_with_offsets().unwrap();

    let mut preview = encoder.image_directory().unwrap();
    let pixels = vec![99u8; 3 * 8 * 8];
    let offset = preview.write_data(&pixels[..]).unwrap() as u32;
    long(&mut preview, 254, 1);
    long(&mut preview, 256, 8);
    long(&mut preview, 257, 8);
    preview.write_tag(Tag::Unknown(258), &[8u16, 8, 8][..]).unwrap();
    short(&mut preview, 259, 1);
    short(&mut preview, 262, 2);
    preview.write_tag(Tag::Unknown(271), "acquire").unwrap();
    preview.write_tag(Tag::Unknown(272), "test").unwrap();
    long(&mut preview, 273, offset);
    short(&mut preview, 277, 3);
    long(&mut preview, 278, 8);
    long(&mut preview, 279, pixels.len() as u32);
    long(&mut preview, 330, at.offset); // SubIFDs
    preview.write_tag(Tag::Unknown(33_434), Rational { n: 1, d: 60 }).unwrap();
    preview.write_tag(Tag::Unknown(50_706), &[1u8, 4, 0, 0][..]).unwrap(); // DNGVersion
    preview.finish().unwrap();
}

fn photograph(path: &Path) -> Photograph {
    Photograph::new(path, "raw", 1.0)
}

#[test]
fn a_mosaic_is_read_at_half_size_to_exact_code_values_and_never_the_preview() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.dng");
    // Every code another; one green photosite of the block (1, 1) clips.
    let mut codes: Vec<u16> = (0..WIDTH * HEIGHT).map(|k| 600 + 7 * k as u16).collect();
    let site = |x: usize, y: usize| (ACTIVE[0] as usize + y) * WIDTH + ACTIVE[1] as usize + x;
    codes[site(3, 2)] = 15_000;
    // Places of R, G, B, G in the block, and where R and B lie in the half-size pixel.
    for (pattern, places, red) in
        [([0, 1, 1, 2], [0, 1, 3, 2], [-0.25, -0.25]), ([1, 2, 0, 1], [2, 0, 1, 3], [-0.25, 0.25])]
    {
        write_dng(&path, pattern, &codes);
        assert_eq!(photograph(&path).size_px().unwrap(), [5, 5]);
        let pixels = photograph(&path).decode().unwrap();
        assert_eq!([pixels.width, pixels.height], [5, 5]);
        let Samples::F32(found) = &pixels.samples else { panic!("floating point") };
        for (k, found) in found.iter().enumerate() {
            let (x, y) = (k / 3 % 5, k / 15);
            let light = |place: usize| {
                let code = codes[site(2 * x + place % 2, 2 * y + place / 2)];
                if u32::from(code) >= WHITE { f32::INFINITY } else { f32::from(code) - f32::from(BLACK[place]) }
            };
            let expected = match k % 3 {
                0 => light(places[0]),
                1 => 0.5 * (light(places[1]) + light(places[3])),
                _ => light(places[2]),
            };
            assert_eq!(*found, expected, "{pattern:?} pixel ({x}, {y}) channel {}", k % 3);
        }
        assert_eq!(pixels.sampling.offset_px, [red, [0.0, 0.0], red.map(|o: f64| -o)]);
        assert_eq!(pixels.sampling.variance_share, [1.0, 0.5, 1.0]);
    }
}

#[test]
fn a_broken_raw_file_is_an_error_and_no_panic() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.dng");
    write_dng(&path, [0, 1, 1, 2], &[600; WIDTH * HEIGHT]);
    let whole = std::fs::read(&path).unwrap();
    for len in [0, 4, 8, 100, 200, whole.len() - 40] {
        std::fs::write(&path, &whole[..len]).unwrap();
        assert!(photograph(&path).decode().is_err(), "{len} of {} bytes", whole.len());
    }
    write_dng(&path, [0, 1, 2, 1], &[600; WIDTH * HEIGHT]);
    assert!(photograph(&path).decode().is_ok(), "an unusual order of R, G, B, G is a mosaic too");
    write_dng(&path, [0, 0, 1, 2], &[600; WIDTH * HEIGHT]);
    assert!(photograph(&path).decode().unwrap_err().to_string().contains("one R, two G"));
}
