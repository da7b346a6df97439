//! Tiny ONNX files, encoded by hand (protocol buffers).

fn varint(mut value: u64) -> Vec<u8> {
    let mut out = Vec::new();
    while value > 127 {
        out.push((value & 127) as u8 | 128);
        value >>= 7;
    }
    out.push(value as u8);
    out
}

fn number(field: u64, value: i64) -> Vec<u8> {
    [varint(field << 3), varint(value as u64)].concat()
}

fn bytes(field: u64, value: &[u8]) -> Vec<u8> {
    [varint(field << 3 | 2), varint(value.len() as u64), value.to_vec()].concat()
}

fn described(name: &str, shape: &[i64]) -> Vec<u8> {
    let dims: Vec<u8> = shape.iter().flat_map(|d| bytes(1, &number(1, *d))).collect();
    let tensor = [number(1, 1), bytes(2, &dims)].concat();
    [bytes(1, name.as_bytes()), bytes(2, &bytes(1, &tensor))].concat()
}

/// A network with a picture as its input, which it does not look at, and outputs (name, shape, values) that never change.
pub(crate) fn constants(input: &[i64], outputs: &[(&str, &[i64], &[f32])]) -> Vec<u8> {
    let mut graph = bytes(2, b"constants");
    for (name, shape, values) in outputs {
        let kept = format!("{name}_kept");
        let node = [bytes(1, kept.as_bytes()), bytes(2, name.as_bytes()), bytes(4, b"Identity")].concat();
        graph.extend(bytes(1, &node));
        let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let dims: Vec<u8> = shape.iter().flat_map(|d| number(1, *d)).collect();
        graph.extend(bytes(5, &[dims, number(2, 1), bytes(8, kept.as_bytes()), bytes(9, &raw)].concat()));
        graph.extend(bytes(12, &described(name, shape)));
    }
    graph.extend(bytes(11, &described("picture", input)));
    let opset = [bytes(1, b""), number(2, 13)].concat();
    [number(1, 7), bytes(7, &graph), bytes(8, &opset)].concat()
}
