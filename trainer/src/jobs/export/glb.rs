//! Binary glTF 2.0 (`.glb`): a header, a JSON chunk, a chunk of numbers.

use serde_json::{Value, json};

/// Buffer view targets of the specification.
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
/// Component types.
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;

/// The numbers of a file under construction, with the accessors that name them.
#[derive(Debug, Default)]
pub(super) struct Numbers {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Numbers {
    fn add(&mut self, bytes: impl Iterator<Item = [u8; 4]>, target: Option<u32>, mut accessor: Value) -> usize {
        let offset = self.bytes.len();
        self.bytes.extend(bytes.flatten());
        let mut view = json!({"buffer": 0, "byteOffset": offset, "byteLength": self.bytes.len() - offset});
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        accessor["bufferView"] = json!(self.views.len());
        self.views.push(view);
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    /// Three numbers per vertex; gives the accessor's number. `bounds` adds the smallest and largest, which positions need.
    pub(super) fn vectors(&mut self, values: &[[f32; 3]], bounds: bool) -> usize {
        let mut accessor = json!({"componentType": FLOAT, "count": values.len(), "type": "VEC3"});
        if bounds {
            let fold = |start: f32, pick: fn(f32, f32) -> f32| -> [f32; 3] {
                std::array::from_fn(|c| values.iter().map(|v| v[c]).fold(start, pick))
            };
            accessor["min"] = json!(fold(f32::INFINITY, f32::min));
            accessor["max"] = json!(fold(f32::NEG_INFINITY, f32::max));
        }
        let bytes = values.iter().flatten().map(|v| v.to_le_bytes());
        self.add(bytes, Some(ARRAY_BUFFER), accessor)
    }

    /// Corners of triangles.
    pub(super) fn indices(&mut self, values: &[u32]) -> usize {
        let accessor = json!({"componentType": UNSIGNED_INT, "count": values.len(), "type": "SCALAR"});
        self.add(values.iter().map(|v| v.to_le_bytes()), Some(ELEMENT_ARRAY_BUFFER), accessor)
    }

    /// Numbers of an animation: times (with their bounds) or weights.
    pub(super) fn scalars(&mut self, values: &[f32], bounds: bool) -> usize {
        let mut accessor = json!({"componentType": FLOAT, "count": values.len(), "type": "SCALAR"});
        if bounds {
            accessor["min"] = json!([values.iter().copied().fold(f32::INFINITY, f32::min)]);
            accessor["max"] = json!([values.iter().copied().fold(f32::NEG_INFINITY, f32::max)]);
        }
        self.add(values.iter().map(|v| v.to_le_bytes()), None, accessor)
    }

    /// The whole file; `document` has everything but buffers, buffer views and accessors.
    pub(super) fn into_file(self, mut document: Value) -> Vec<u8> {
        document["buffers"] = json!([{"byteLength": self.bytes.len()}]);
        document["bufferViews"] = Value::Array(self.views);
        document["accessors"] = Value::Array(self.accessors);
        let mut text = document.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut numbers = self.bytes;
        numbers.resize(numbers.len().next_multiple_of(4), 0);
        let total = 12 + 8 + text.len() + 8 + numbers.len();
        let mut file = Vec::with_capacity(total);
        let word = |file: &mut Vec<u8>, v: u32| file.extend(v.to_le_bytes());
        file.extend(b"glTF");
        word(&mut file, 2);
        word(&mut file, total as u32);
        word(&mut file, text.len() as u32);
        file.extend(b"JSON");
        file.extend(text);
        word(&mut file, numbers.len() as u32);
        file.extend(b"BIN\0");
        file.extend(numbers);
        file
    }
}
