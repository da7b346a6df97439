//! Reads the pickled weights of LPIPS: dictionaries of 32-bit arrays. No code of the file runs: every class but NumPy's
//! array and its kind of number is refused, and those stand for shape and bytes alone.

use std::collections::BTreeMap;

/// A value of a pickle, as far as weights are made of.
#[derive(Clone, Debug)]
pub(super) enum PickleValue {
    Nothing,
    Int(i64),
    Text(String),
    Bytes(Vec<u8>),
    Tuple(Vec<PickleValue>),
    Dict(BTreeMap<String, PickleValue>),
    /// A class by module and name.
    Class(String, String),
    /// The kind of number of an array, such as `f4`.
    Kind(String),
    /// A 32-bit array that is not filled yet.
    EmptyArray,
    Array(FloatArray),
}

/// A 32-bit array as it is stored.
#[derive(Clone, Debug)]
pub(super) struct FloatArray {
    pub(super) shape: Vec<i64>,
    pub(super) raw: Vec<u8>,
}

impl PickleValue {
    /// An entry of a dictionary.
    pub(super) fn get(&self, key: &str) -> Option<&Self> {
        match self {
            Self::Dict(map) => map.get(key),
            _ => None,
        }
    }

    pub(super) fn array(&self) -> Option<&FloatArray> {
        match self {
            Self::Array(array) => Some(array),
            _ => None,
        }
    }

    fn text(self) -> Option<String> {
        if let Self::Text(text) = self { Some(text) } else { None }
    }
}

struct Reader<'a> {
    data: &'a [u8],
    at: usize,
    stack: Vec<PickleValue>,
    marks: Vec<usize>,
    memo: BTreeMap<usize, PickleValue>,
}

/// What a step came to.
enum Step {
    Next,
    End(PickleValue),
}

impl Reader<'_> {
    fn take(&mut self, count: usize) -> Option<&[u8]> {
        let begin = self.at;
        self.at = begin.checked_add(count)?;
        self.data.get(begin..self.at)
    }

    /// A little-endian number of so many bytes.
    fn number(&mut self, bytes: usize) -> Option<usize> {
        Some(self.take(bytes)?.iter().rev().fold(0, |n, &b| n << 8 | usize::from(b)))
    }

    fn line(&mut self) -> Option<String> {
        let length = self.data.get(self.at..)?.iter().position(|&b| b == b'\n')?;
        let line = std::str::from_utf8(self.take(length)?).ok()?.to_owned();
        self.at += 1;
        Some(line)
    }

    fn string(&mut self, length: usize) -> Option<PickleValue> {
        Some(PickleValue::Text(std::str::from_utf8(self.take(length)?).ok()?.to_owned()))
    }

    fn since_mark(&mut self) -> Option<Vec<PickleValue>> {
        let mark = self.marks.pop()?;
        (mark <= self.stack.len()).then(|| self.stack.split_off(mark))
    }

    fn tuple(&mut self, count: usize) -> Option<PickleValue> {
        let begin = self.stack.len().checked_sub(count)?;
        Some(PickleValue::Tuple(self.stack.split_off(begin)))
    }

    fn fill(&mut self, items: Vec<PickleValue>) -> Option<()> {
        let PickleValue::Dict(map) = self.stack.last_mut()? else { return None };
        let mut items = items.into_iter();
        while let (Some(key), Some(value)) = (items.next(), items.next()) {
            map.insert(key.text()?, value);
        }
        Some(())
    }

    /// One step.
    fn step(&mut self) -> Option<Step> {
        use PickleValue::{Bytes, Dict, Int, Nothing};
        let value = match self.number(1)? as u8 {
            0x80 => self.take(1).map(|_| None)?,
            0x95 => self.take(8).map(|_| None)?,
            b'.' => return self.stack.pop().map(Step::End),
            b'}' => Some(Dict(BTreeMap::new())),
            b')' => Some(PickleValue::Tuple(Vec::new())),
            b'N' => Some(Nothing),
            0x88 => Some(Int(1)),
            0x89 => Some(Int(0)),
            b'K' => Some(Int(self.number(1)? as i64)),
            b'M' => Some(Int(self.number(2)? as i64)),
            b'J' => Some(Int(i64::from(self.number(4)? as u32 as i32))),
            b'X' => {
                let length = self.number(4)?;
                Some(self.string(length)?)
            }
            0x8c => {
                let length = self.number(1)?;
                Some(self.string(length)?)
            }
            b'B' => {
                let length = self.number(4)?;
                Some(Bytes(self.take(length)?.to_vec()))
            }
            b'C' => {
                let length = self.number(1)?;
                Some(Bytes(self.take(length)?.to_vec()))
            }
            b'(' => {
                self.marks.push(self.stack.len());
                None
            }
            b'q' | b'r' | 0x94 => {
                let key = match self.data[self.at - 1] {
                    b'q' => self.number(1)?,
                    b'r' => self.number(4)?,
                    _ => self.memo.len(),
                };
                // What is filled later is never asked for again by weights.
                self.memo.insert(key, self.stack.last()?.clone());
                None
            }
            b'h' => {
                let key = self.number(1)?;
                Some(self.memo.get(&key)?.clone())
            }
            b'j' => {
                let key = self.number(4)?;
                Some(self.memo.get(&key)?.clone())
            }
            b'c' => Some(PickleValue::Class(self.line()?, self.line()?)),
            0x93 => {
                let name = self.stack.pop()?.text()?;
                Some(PickleValue::Class(self.stack.pop()?.text()?, name))
            }
            0x85 => Some(self.tuple(1)?),
            0x86 => Some(self.tuple(2)?),
            0x87 => Some(self.tuple(3)?),
            b't' => Some(PickleValue::Tuple(self.since_mark()?)),
            b's' => {
                let value = self.stack.pop()?;
                let key = self.stack.pop()?;
                self.fill(vec![key, value])?;
                None
            }
            b'u' => {
                let items = self.since_mark()?;
                self.fill(items)?;
                None
            }
            b'R' => {
                let arguments = self.stack.pop()?;
                Some(call(&self.stack.pop()?, arguments)?)
            }
            b'b' => {
                let state = self.stack.pop()?;
                Some(built(self.stack.pop()?, state)?)
            }
            _ => return None,
        };
        self.stack.extend(value);
        Some(Step::Next)
    }
}

/// What a known function of NumPy makes.
fn call(class: &PickleValue, arguments: PickleValue) -> Option<PickleValue> {
    let PickleValue::Class(module, name) = class else { return None };
    let PickleValue::Tuple(arguments) = arguments else { return None };
    let mut arguments = arguments.into_iter();
    match (module.as_str(), name.as_str()) {
        ("numpy.core.multiarray" | "numpy._core.multiarray", "_reconstruct") => Some(PickleValue::EmptyArray),
        ("numpy", "dtype") => Some(PickleValue::Kind(arguments.next()?.text()?)),
        // Bytes as older pickles write them: each one a character.
        ("_codecs", "encode") => {
            let text = arguments.next()?.text()?;
            let bytes = text.chars().map(|c| u8::try_from(u32::from(c)).ok()).collect::<Option<_>>()?;
            Some(PickleValue::Bytes(bytes))
        }
        _ => None,
    }
}

/// What becomes of an object by its state.
fn built(object: PickleValue, state: PickleValue) -> Option<PickleValue> {
    let PickleValue::Tuple(state) = state else { return None };
    match object {
        // Byte order: little-endian is the only one.
        PickleValue::Kind(kind) => {
            matches!(state.get(1)?, PickleValue::Text(order) if order == "<").then_some(PickleValue::Kind(kind))
        }
        PickleValue::EmptyArray => {
            let [_, shape, kind, by_column, raw] = <[PickleValue; 5]>::try_from(state).ok()?;
            let (PickleValue::Tuple(shape), PickleValue::Bytes(raw)) = (shape, raw) else { return None };
            let plain = matches!(by_column, PickleValue::Int(0));
            let floats = matches!(kind, PickleValue::Kind(name) if name == "f4");
            let shape = shape.iter().map(|s| if let PickleValue::Int(n) = s { Some(*n) } else { None });
            let shape = shape.collect::<Option<Vec<i64>>>()?;
            (plain && floats).then_some(PickleValue::Array(FloatArray { shape, raw }))
        }
        _ => None,
    }
}

/// The value that a pickle holds; `None` for one that is cut or holds anything else than dictionaries of arrays.
pub(super) fn read_pickle(data: &[u8]) -> Option<PickleValue> {
    let mut reader = Reader { data, at: 0, stack: Vec::new(), marks: Vec::new(), memo: BTreeMap::new() };
    loop {
        if let Step::End(value) = reader.step()? {
            return Some(value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_classes_are_refused() {
        // cos\nsystem\n(X\x04\0\0\0truetR.
        assert!(read_pickle(b"cos\nsystem\n(X\x04\0\0\0truetR.").is_none());
        assert!(read_pickle(b"\x80\x02}X\x01\0\0\0a").is_none(), "no end");
    }

    #[test]
    fn a_dictionary_reads() {
        let value = read_pickle(b"\x80\x02}(X\x01\0\0\0aK\x05X\x01\0\0\0b}u.").unwrap();
        assert!(matches!(value.get("a"), Some(PickleValue::Int(5))), "{value:?}");
        assert!(matches!(value.get("b"), Some(PickleValue::Dict(_))));
    }
}
