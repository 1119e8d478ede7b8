// A policy from its ONNX file: reads the file and evaluates the few operators of an MLP.

const DECODER = new TextDecoder();
const FLOAT = 1, INT64 = 7, DOUBLE = 11;

/** The fields of a protobuf message, by number: numbers, or bytes still to be read. */
function fields(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const found = {};
  let at = 0;
  const varint = () => {
    let value = 0n;
    for (let shift = 0n; ; shift += 7n) {
      const byte = bytes[at++];
      value |= BigInt(byte & 127) << shift;
      if (byte < 128) return Number(BigInt.asIntN(64, value));
    }
  };
  while (at < bytes.length) {
    const key = varint();
    let value;
    if ((key & 7) === 0) value = varint();
    else if ((key & 7) === 1) { value = view.getFloat64(at, true); at += 8; }
    else if ((key & 7) === 5) { value = view.getFloat32(at, true); at += 4; }
    else if ((key & 7) === 2) { const size = varint(); value = bytes.subarray(at, at += size); }
    else throw new Error("This is not an ONNX file.");
    (found[key >> 3] ??= []).push(value);
  }
  return found;
}

const text = (bytes) => DECODER.decode(bytes);

/** Numbers of a tensor that is stored as raw bytes, as the exporter stores them. */
function tensor(bytes) {
  const { 1: dims = [], 2: [type], 8: [name] = [new Uint8Array()], 9: [raw] = [] } = fields(bytes);
  if (!raw) throw new Error(`Tensor ${text(name)} has no raw data.`);
  const kind = { [FLOAT]: Float32Array, [DOUBLE]: Float64Array, [INT64]: BigInt64Array }[type];
  if (!kind) throw new Error(`Tensor ${text(name)} has the unknown type ${type}.`);
  return { name: text(name), shape: dims, values: new kind(raw.slice().buffer) };
}

function attributes(node) {
  const found = {};
  for (const bytes of node[5] ?? []) {
    const { 1: [name], 2: [float] = [], 3: [integer] = [] } = fields(bytes);
    found[text(name)] = float ?? integer;
  }
  return found;
}

/** Apply a function of two numbers elementwise; one number stands for a whole vector. */
function pairwise(a, b, combine) {
  const size = Math.max(a.length, b.length);
  const kind = a instanceof Float64Array ? Float64Array : Float32Array;
  const at = (x, i) => x[x.length === 1 ? 0 : i];
  return kind.from({ length: size }, (_, i) => combine(at(a, i), at(b, i)));
}

function gemm([x, weights, bias], { transB = 0 }, shapes) {
  const [rows, columns] = shapes[1];
  const [outputs, inputs] = transB ? [rows, columns] : [columns, rows];
  const result = new Float32Array(outputs);
  for (let o = 0; o < outputs; o++) {
    let sum = bias ? bias[o] : 0;
    for (let i = 0; i < inputs; i++) {
      sum += x[i] * weights[transB ? o * inputs + i : i * outputs + o];
    }
    result[o] = sum;
  }
  return result;
}

const OPERATORS = {
  Add: ([a, b]) => pairwise(a, b, (x, y) => x + y),
  Cast: ([a], { to }) => (to === DOUBLE ? Float64Array.from(a) : Float32Array.from(a)),
  Clip: ([a, low, high]) => a.map((x) => Math.min(Math.max(x, low[0]), high[0])),
  Div: ([a, b]) => pairwise(a, b, (x, y) => x / y),
  Elu: ([a], { alpha = 1 }) => a.map((x) => (x < 0 ? alpha * Math.expm1(x) : x)),
  Gemm: gemm,
  Identity: ([a]) => a,
  LeakyRelu: ([a], { alpha = 0.01 }) => a.map((x) => (x < 0 ? alpha * x : x)),
  Max: ([a, b]) => pairwise(a, b, Math.max),
  Min: ([a, b]) => pairwise(a, b, Math.min),
  Mul: ([a, b]) => pairwise(a, b, (x, y) => x * y),
  Relu: ([a]) => a.map((x) => Math.max(x, 0)),
  Sub: ([a, b]) => pairwise(a, b, (x, y) => x - y),
  Tanh: ([a]) => a.map(Math.tanh),
};

/** An agent: the observation in, the action out. */
export class Policy {
  /** @param {ArrayBuffer} file the ONNX file */
  constructor(file) {
    const graph = fields(fields(new Uint8Array(file))[7][0]);
    this.constants = new Map((graph[5] ?? []).map(tensor).map((t) => [t.name, t]));
    this.nodes = graph[1].map(fields).map((node) => ({
      operator: text(node[4][0]),
      inputs: (node[1] ?? []).map(text),
      output: text(node[2][0]),
      attributes: attributes(node),
    }));
    for (const { operator } of this.nodes) {
      if (!OPERATORS[operator]) throw new Error(`The page does not know the operator ${operator}.`);
    }
    const inputs = graph[11].map((bytes) => text(fields(bytes)[1][0]));
    this.input = inputs.find((name) => !this.constants.has(name));
  }

  /** @param {Float32Array} observation @returns {Float32Array} the action */
  act(observation) {
    const values = new Map([[this.input, observation]]);
    const value = (name) => values.get(name) ?? this.constants.get(name)?.values;
    for (const { operator, inputs, output, attributes } of this.nodes) {
      const shapes = inputs.map((name) => this.constants.get(name)?.shape);
      values.set(output, OPERATORS[operator](inputs.map(value), attributes, shapes));
    }
    return values.get("action");
  }
}
