// The avatar's numbers out of the page: base64 → gzip → safetensors → typed arrays.

function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
  return bytes;
}

async function inflate(bytes) {
  if (!globalThis.DecompressionStream) throw new Error("this browser is too old: it has no DecompressionStream (Chrome 80, Firefox 113, Safari 16.4 have it)");
  return new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer());
}

// IEEE 754 half precision.
function half(bits) {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
}

const READ = {
  F32: (buffer) => new Float32Array(buffer),
  F16: (buffer) => Float32Array.from(new Uint16Array(buffer), half),
  I16: (buffer) => Float32Array.from(new Int16Array(buffer), (v) => v / 32767),
  U8: (buffer) => Float32Array.from(new Uint8Array(buffer), (v) => v / 255),
  I8: (buffer) => new Int8Array(buffer),
};

// Every array by its name; floats except the bytes of deltas.
export async function readNumbers(base64) {
  const bytes = await inflate(bytesOf(base64.trim()));
  const length = Number(new DataView(bytes.buffer).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + length)));
  const arrays = {};
  for (const [name, { dtype, data_offsets: [from, to] }] of Object.entries(header))
    if (READ[dtype]) arrays[name] = READ[dtype](bytes.slice(8 + length + from, 8 + length + to).buffer);
  return arrays;
}
