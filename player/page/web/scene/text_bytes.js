// Decodes bytes from the text of a page: seven characters stand for six bytes. The twin of player/page/text_bytes.py.

const LEFT_OUT = "\0\n\r\v\f\x1a\x1b\"&'<\x7f";
const N_BYTES = 6;
const N_CHARACTERS = 7;
const DIGIT = new Int8Array(128).fill(-1); // the digit that each character stands for
let base = 0;
for (let code = 0; code < 128; code++) if (!LEFT_OUT.includes(String.fromCharCode(code))) DIGIT[code] = base++;

const HALF = 116 ** 4;

// Return the `length` bytes that a text encodes; null if the text has another length, or characters that are not in the
// alphabet.
export function bytesOf(text, length) {
  const nGroups = Math.ceil(length / N_BYTES);
  if (text.length !== nGroups * N_CHARACTERS) return null;
  const bytes = new Uint8Array(nGroups * N_BYTES);
  for (let group = 0; group < nGroups; group++) {
    if (!putGroup(text, N_CHARACTERS * group, bytes, N_BYTES * group)) return null;
  }
  return bytes.subarray(0, length);
}

// Return the digit of a character; negative if the character is not in the alphabet.
function digitAt(text, at) {
  const code = text.charCodeAt(at);
  return code < 128 ? DIGIT[code] : -1;
}

// Decode seven characters to six bytes; return whether all of them are in the alphabet.
function putGroup(text, from, bytes, to) {
  const a = digitAt(text, from), b = digitAt(text, from + 1), c = digitAt(text, from + 2), d = digitAt(text, from + 3);
  const e = digitAt(text, from + 4), f = digitAt(text, from + 5), g = digitAt(text, from + 6);
  const number = a + 116 * (b + 116 * (c + 116 * d)) + HALF * (e + 116 * (f + 116 * g)); // below 2^48, exact
  const lowest = number >>> 0;
  const highest = (number - lowest) / 4294967296;
  bytes[to] = lowest;
  bytes[to + 1] = lowest >>> 8;
  bytes[to + 2] = lowest >>> 16;
  bytes[to + 3] = lowest >>> 24;
  bytes[to + 4] = highest;
  bytes[to + 5] = highest >>> 8;
  return (a | b | c | d | e | f | g) >= 0;
}
