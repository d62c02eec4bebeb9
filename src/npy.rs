//! NumPy arrays: the header of an `.npy` file or of an array of an NPZ archive, and its numbers as f64.
//!
//! Read here rather than by `npyz`, whose parser trusts the sizes that a header states.

use std::io::Read;

/// The longest header of an array that is read, bytes; NumPy writes 128.
const LONGEST_HEADER: usize = 4096;
/// Numbers that are read at a time: memory grows with what is really there.
const AT_ONCE: usize = 1 << 16;

/// What stands before the numbers (NumPy Enhancement Proposal 1).
#[derive(Debug)]
pub(crate) struct NpyHeader {
    /// Numbers along each axis.
    pub(crate) shape: Vec<u64>,
    /// The type as NumPy writes it, `<f4`.
    pub(crate) kind: String,
    fortran_order: bool,
    number: NumberType,
}

#[derive(Debug, Clone, Copy)]
enum NumberType {
    Float(usize),
    Signed(usize),
    Unsigned(usize),
}

impl NpyHeader {
    /// Reads it, to the first number.
    pub(crate) fn read(reader: &mut impl Read) -> Result<Self, String> {
        let mut bytes = |n: usize| {
            let mut buffer = vec![0u8; n];
            reader.read_exact(&mut buffer).map(|()| buffer).map_err(|e| e.to_string())
        };
        let start = bytes(8)?;
        if &start[..6] != b"\x93NUMPY" {
            return Err("no NumPy array".into());
        }
        let len = match start[6] {
            1 => bytes(2)?.iter().rev().fold(0, |n, b| n << 8 | usize::from(*b)),
            2 | 3 => bytes(4)?.iter().rev().fold(0, |n, b| n << 8 | usize::from(*b)),
            version => return Err(format!("version {version} of the NumPy format")),
        };
        if len > LONGEST_HEADER {
            return Err(format!("a header of {len} bytes"));
        }
        Self::parse(&String::from_utf8_lossy(&bytes(len)?))
    }

    /// Reads `{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), }`.
    fn parse(text: &str) -> Result<Self, String> {
        let after = |key: &str| {
            let (_, rest) = text.split_once(&format!("'{key}':")).ok_or_else(|| format!("no {key} in its header"))?;
            Ok::<_, String>(rest.trim_start())
        };
        let kind = after("descr")?.split(['\'', '"']).nth(1).unwrap_or("?").to_owned();
        let number = match kind.trim_start_matches(['<', '>', '=', '|']) {
            "f2" => NumberType::Float(2),
            "f4" => NumberType::Float(4),
            "f8" => NumberType::Float(8),
            "i1" => NumberType::Signed(1),
            "i2" => NumberType::Signed(2),
            "i4" => NumberType::Signed(4),
            "i8" => NumberType::Signed(8),
            "b1" | "u1" => NumberType::Unsigned(1),
            "u2" => NumberType::Unsigned(2),
            "u4" => NumberType::Unsigned(4),
            "u8" => NumberType::Unsigned(8),
            _ => return Err(format!("numbers of type {kind} (float32 or float64 are read)")),
        };
        let shape = after("shape")?.strip_prefix('(').and_then(|rest| rest.split(')').next()).ok_or("no shape")?;
        let sides = shape.split(',').map(str::trim).filter(|side| !side.is_empty());
        let shape: Vec<u64> =
            sides.map(|side| side.parse()).collect::<Result<_, _>>().map_err(|_| format!("shape ({shape})"))?;
        Ok(Self { shape, kind, fortran_order: after("fortran_order")?.starts_with("True"), number })
    }

    /// Whether the numbers are f32 or f64.
    pub(crate) fn is_float(&self) -> bool {
        matches!(self.number, NumberType::Float(4 | 8))
    }

    /// The `len` numbers that follow the header in C order, each as `make` has it; `len` is the product of the shape.
    pub(crate) fn numbers<T: Copy>(
        &self,
        reader: &mut impl Read,
        len: usize,
        make: impl Fn(f64) -> T,
    ) -> Result<Vec<T>, String> {
        let (NumberType::Float(bytes) | NumberType::Signed(bytes) | NumberType::Unsigned(bytes)) = self.number;
        let mut values = Vec::new();
        let mut chunk = vec![0u8; AT_ONCE * bytes];
        while values.len() < len {
            let wanted = (len - values.len()).min(AT_ONCE) * bytes;
            reader.read_exact(&mut chunk[..wanted]).map_err(|e| e.to_string())?;
            values.extend(chunk[..wanted].chunks_exact(bytes).map(|b| make(self.one(b))));
        }
        // To the end, so that an archive's checksum is checked.
        if std::io::copy(&mut reader.take(1), &mut std::io::sink()).map_err(|e| e.to_string())? > 0 {
            return Err(format!("more than the {len} numbers of its shape"));
        }
        Ok(if self.fortran_order { c_order(&self.shape, &values) } else { values })
    }

    fn one(&self, bytes: &[u8]) -> f64 {
        let mut raw = [0u8; 8];
        for (i, b) in bytes.iter().enumerate() {
            raw[if self.kind.starts_with('>') { bytes.len() - 1 - i } else { i }] = *b;
        }
        let [a, b, c, d, ..] = raw;
        match self.number {
            NumberType::Float(2) => half::f16::from_le_bytes([a, b]).into(),
            NumberType::Float(4) => f64::from(f32::from_le_bytes([a, b, c, d])),
            NumberType::Float(_) => f64::from_le_bytes(raw),
            NumberType::Unsigned(_) => u64::from_le_bytes(raw) as f64,
            NumberType::Signed(bytes) => {
                // The sign goes to where i64 has it, and back.
                let unused = 64 - 8 * bytes as u32;
                ((i64::from_le_bytes(raw) << unused) >> unused) as f64
            }
        }
    }
}

/// Values whose first axis runs fastest, in C order.
fn c_order<T: Copy>(shape: &[u64], values: &[T]) -> Vec<T> {
    let place = |i: usize| {
        let (mut rest, mut strides) = (i, values.len());
        let mut place = 0;
        for n in shape.iter().rev().map(|&n| n as usize) {
            strides /= n;
            place += rest % n * strides;
            rest /= n;
        }
        place
    };
    (0..values.len()).map(|i| values[place(i)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn array(kind: &str, fortran: &str, shape: &str, bytes: &[u8]) -> Vec<u8> {
        let header = format!("{{'descr': '{kind}', 'fortran_order': {fortran}, 'shape': {shape}, }}\n");
        let len = (header.len() as u16).to_le_bytes();
        [b"\x93NUMPY\x01\x00".as_slice(), &len, header.as_bytes(), bytes].concat()
    }

    fn read(file: &[u8]) -> Result<(Vec<u64>, Vec<f64>), String> {
        let mut file = file;
        let header = NpyHeader::read(&mut file)?;
        let len = header.shape.iter().product::<u64>() as usize;
        let values = header.numbers(&mut file, len, |v| v)?;
        Ok((header.shape, values))
    }

    #[test]
    fn numbers_of_every_type_and_order_are_read() {
        let one = |kind: &str, bytes: &[u8]| read(&array(kind, "False", "()", bytes)).unwrap().1[0];
        assert_eq!(one("<f4", &(-1.5_f32).to_le_bytes()), -1.5);
        assert_eq!(one(">f8", &1e300_f64.to_be_bytes()), 1e300);
        assert_eq!(one("<f2", &[0x00, 0xc2]), -3.0);
        assert_eq!(one("|b1", &[1]), 1.0);
        assert_eq!(one("|i1", &[0xfe]), -2.0);
        assert_eq!(one(">i2", &(-300_i16).to_be_bytes()), -300.0);
        assert_eq!(one("<i8", &(-5_i64).to_le_bytes()), -5.0);
        assert_eq!(one("<u4", &u32::MAX.to_le_bytes()), f64::from(u32::MAX));
        let fortran = read(&array("|u1", "True", "(2, 3)", &[0, 1, 2, 3, 4, 5])).unwrap();
        assert_eq!(fortran, (vec![2, 3], vec![0.0, 2.0, 4.0, 1.0, 3.0, 5.0]));
    }

    #[test]
    fn files_that_are_cut_or_go_on_or_hold_other_things_are_refused() {
        let said = |file: &[u8]| read(file).unwrap_err();
        assert!(said(b"PK").contains("fill whole buffer"));
        assert_eq!(said(b"not an array"), "no NumPy array");
        assert!(said(&array("<c8", "False", "(1,)", &[0; 8])).contains("type <c8"));
        assert!(said(&array("|O", "False", "(1,)", &[0; 8])).contains("type |O"));
        assert!(said(&array("<f4", "False", "(2,)", &[0; 7])).contains("fill whole buffer"));
        assert!(said(&array("<f4", "False", "(1,)", &[0; 5])).contains("more than the 1 numbers"));
        assert!(said(&array("<f4", "False", "(x,)", &[0; 4])).contains("shape"));
    }
}
