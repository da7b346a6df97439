//! Reads TensorFlow Lite files: just as much of the format (a FlatBuffer) as converting a network needs.
//!
//! Fields are found by their numbers in the schema `tensorflow/lite/schema/schema.fbs`. Every read is checked: `None` is a
//! file that ends early or points outside of itself.

use half::f16;

const TYPE_FLOAT32: i8 = 0;
const TYPE_FLOAT16: i8 = 1;
const TYPE_INT32: i8 = 2;

/// `BuiltinOperator` of the schema, as far as it is used.
const OPERATORS: [(i32, &str); 22] = [
    (0, "ADD"),
    (2, "CONCATENATION"),
    (3, "CONV_2D"),
    (4, "DEPTHWISE_CONV_2D"),
    (6, "DEQUANTIZE"),
    (14, "LOGISTIC"),
    (17, "MAX_POOL_2D"),
    (18, "MUL"),
    (19, "RELU"),
    (22, "RESHAPE"),
    (34, "PAD"),
    (39, "TRANSPOSE"),
    (40, "MEAN"),
    (41, "SUB"),
    (42, "DIV"),
    (45, "STRIDED_SLICE"),
    (54, "PRELU"),
    (59, "NEG"),
    (74, "SUM"),
    (75, "SQRT"),
    (76, "RSQRT"),
    (99, "SQUARED_DIFFERENCE"),
];

fn bytes_at<const N: usize>(data: &[u8], at: usize) -> Option<[u8; N]> {
    data.get(at..at.checked_add(N)?)?.try_into().ok()
}

fn u32_at(data: &[u8], at: usize) -> Option<usize> {
    bytes_at(data, at).map(|b| u32::from_le_bytes(b) as usize)
}

/// A FlatBuffer table: fields by their number in the schema.
#[derive(Clone, Copy, Debug)]
pub(super) struct FlatTable<'a> {
    data: &'a [u8],
    at: usize,
    fields: usize,
    count: usize,
}

/// A file ends in the middle.
struct Cut;

impl<'a> FlatTable<'a> {
    fn new(data: &'a [u8], at: usize) -> Option<Self> {
        let back = i64::from(i32::from_le_bytes(bytes_at(data, at)?));
        let fields = usize::try_from(at as i64 - back).ok()?;
        let size = usize::from(u16::from_le_bytes(bytes_at(data, fields)?));
        Some(Self { data, at, fields, count: size.checked_sub(4)? / 2 })
    }

    /// Where a field lies; 0 for one that is left out.
    fn offset(&self, field: usize) -> Option<usize> {
        if field >= self.count {
            return Some(0);
        }
        bytes_at(self.data, self.fields + 4 + 2 * field).map(|b| usize::from(u16::from_le_bytes(b)))
    }

    /// A 32-bit number, 0 where it is left out.
    pub(super) fn int(&self, field: usize) -> Option<i32> {
        match self.offset(field)? {
            0 => Some(0),
            offset => bytes_at(self.data, self.at + offset).map(i32::from_le_bytes),
        }
    }

    /// An 8-bit number, 0 where it is left out.
    pub(super) fn byte(&self, field: usize) -> Option<i8> {
        match self.offset(field)? {
            0 => Some(0),
            offset => bytes_at(self.data, self.at + offset).map(i8::from_le_bytes),
        }
    }

    /// Where a table or a vector lies; 0 for one that is left out.
    fn target(&self, field: usize) -> Option<usize> {
        match self.offset(field)? {
            0 => Some(0),
            offset => (self.at + offset).checked_add(u32_at(self.data, self.at + offset)?),
        }
    }

    /// The table of a field, if it has one; the error is that of a file that is cut.
    fn table(&self, field: usize) -> Result<Option<Self>, Cut> {
        match self.target(field).ok_or(Cut)? {
            0 => Ok(None),
            target => Self::new(self.data, target).map(Some).ok_or(Cut),
        }
    }

    fn tables(&self, field: usize) -> Option<Vec<Self>> {
        let target = self.target(field)?;
        if target == 0 {
            return Some(Vec::new());
        }
        let count = u32_at(self.data, target)?.min(self.data.len());
        let of = |i: usize| {
            let place = target + 4 + 4 * i;
            Self::new(self.data, place + u32_at(self.data, place)?)
        };
        (0..count).map(of).collect()
    }

    fn ints(&self, field: usize) -> Option<Vec<i32>> {
        match self.target(field)? {
            0 => Some(Vec::new()),
            target => {
                let count = u32_at(self.data, target)?.min(self.data.len());
                (0..count).map(|i| bytes_at(self.data, target + 4 + 4 * i).map(i32::from_le_bytes)).collect()
            }
        }
    }

    fn bytes(&self, field: usize) -> Option<&'a [u8]> {
        match self.target(field)? {
            0 => Some(&[]),
            target => {
                let begin = target + 4;
                self.data.get(begin..begin.checked_add(u32_at(self.data, target)?)?)
            }
        }
    }
}

/// The values of a constant tensor.
#[derive(Clone, Debug)]
pub(super) enum TensorValues {
    Floats(Vec<f32>),
    Ints(Vec<i64>),
}

impl TensorValues {
    fn read(kind: i8, raw: &[u8]) -> Option<Self> {
        let floats = |values: Vec<f32>| Some(Self::Floats(values));
        match kind {
            _ if raw.is_empty() => None,
            TYPE_FLOAT32 => floats(raw.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()),
            TYPE_FLOAT16 => floats(raw.as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect()),
            TYPE_INT32 => {
                let ints = raw.as_chunks::<4>().0.iter().map(|b| i64::from(i32::from_le_bytes(*b)));
                Some(Self::Ints(ints.collect()))
            }
            _ => None,
        }
    }

    pub(super) fn floats(&self) -> Vec<f32> {
        match self {
            Self::Floats(values) => values.clone(),
            Self::Ints(values) => values.iter().map(|&v| v as f32).collect(),
        }
    }

    pub(super) fn ints(&self) -> Option<&[i64]> {
        match self {
            Self::Ints(values) => Some(values),
            Self::Floats(_) => None,
        }
    }
}

#[derive(Clone, Debug)]
pub(super) struct TfliteTensor {
    pub(super) shape: Vec<i64>,
    pub(super) name: String,
    pub(super) values: Option<TensorValues>,
}

#[derive(Clone, Debug)]
pub(super) struct TfliteOperator<'a> {
    pub(super) kind: &'static str,
    /// Numbers of tensors; −1 is one that is left out.
    pub(super) inputs: Vec<i32>,
    pub(super) outputs: Vec<i32>,
    pub(super) options: Option<FlatTable<'a>>,
}

/// The first graph of a file: tensors, operators in the order they run, numbers of input and output tensors.
#[derive(Clone, Debug)]
pub(super) struct TfliteNetwork<'a> {
    pub(super) tensors: Vec<TfliteTensor>,
    pub(super) inputs: Vec<i32>,
    pub(super) outputs: Vec<i32>,
    pub(super) operators: Vec<TfliteOperator<'a>>,
}

impl<'a> TfliteNetwork<'a> {
    pub(super) fn read(data: &'a [u8]) -> Option<Self> {
        if data.get(4..8)? != b"TFL3" {
            return None;
        }
        let model = FlatTable::new(data, u32_at(data, 0)?)?;
        let code = |c: FlatTable<'_>| Some(i32::from(c.byte(0)?).max(c.int(3)?));
        let codes = model.tables(1)?.into_iter().map(code).collect::<Option<Vec<_>>>()?;
        let buffers = model.tables(4)?.iter().map(|b| b.bytes(0)).collect::<Option<Vec<_>>>()?;
        let graph = *model.tables(2)?.first()?;
        let tensor = |t: FlatTable<'a>| {
            let raw: &[u8] = buffers.get(usize::try_from(t.int(2)?).ok()?)?;
            Some(TfliteTensor {
                shape: t.ints(0)?.into_iter().map(i64::from).collect(),
                name: std::str::from_utf8(t.bytes(3)?).ok()?.to_owned(),
                values: TensorValues::read(t.byte(1)?, raw),
            })
        };
        let operator = |o: FlatTable<'a>| {
            let number = *codes.get(usize::try_from(o.int(0)?).ok()?)?;
            let kind = OPERATORS.iter().find(|(n, _)| *n == number)?.1;
            Some(TfliteOperator { kind, inputs: o.ints(1)?, outputs: o.ints(2)?, options: o.table(4).ok()? })
        };
        Some(Self {
            tensors: graph.tables(0)?.into_iter().map(tensor).collect::<Option<_>>()?,
            inputs: graph.ints(1)?,
            outputs: graph.ints(2)?,
            operators: graph.tables(3)?.into_iter().map(operator).collect::<Option<_>>()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_are_none_are_refused() {
        for data in [&b""[..], b"....TFL3", b"\xff\xff\xff\xffTFL3", b"\x08\0\0\0TFL3\x08\0\0\0"] {
            assert!(TfliteNetwork::read(data).is_none(), "{data:?}");
        }
    }

    #[test]
    fn half_floats_become_floats() {
        let values = TensorValues::read(TYPE_FLOAT16, &[0x00, 0x3c, 0x00, 0xc0]).unwrap().floats();
        assert_eq!(values, [1.0, -2.0]);
    }
}
