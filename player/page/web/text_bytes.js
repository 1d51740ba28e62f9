// Bytes out of the text of a page: seven characters for six bytes. The twin of player/page/text_bytes.py.

const LEFT_OUT = "\0\n\r\v\f\x1a\x1b\"&'<\x7f";
const N_BYTES = 6;
const N_CHARACTERS = 7;
const DIGIT = new Int8Array(128).fill(-1); // the digit that each character stands for
let base = 0;
for (let code = 0; code < 128; code++) if (!LEFT_OUT.includes(String.fromCharCode(code))) DIGIT[code] = base++;

const HALF = 116 ** 4;

// The first `length` bytes of what the text holds; null if it holds fewer, or other characters.
export function bytesOf(text, length) {
  const nGroups = Math.ceil(length / N_BYTES);
  if (text.length !== nGroups * N_CHARACTERS) return null;
  const bytes = new Uint8Array(nGroups * N_BYTES);
  let wrong = 0; // negative where a character is none of the alphabet
  let from = 0;
  let to = 0;
  const digit = () => {
    const code = text.charCodeAt(from++);
    const found = code < 128 ? DIGIT[code] : -1;
    wrong |= found;
    return found;
  };
  for (let group = 0; group < nGroups; group++) {
    const low = digit() + 116 * (digit() + 116 * (digit() + 116 * digit()));
    const high = digit() + 116 * (digit() + 116 * digit());
    const number = low + HALF * high; // below 2^48, exact
    const lowest = number >>> 0;
    const highest = (number - lowest) / 4294967296;
    bytes[to++] = lowest;
    bytes[to++] = lowest >>> 8;
    bytes[to++] = lowest >>> 16;
    bytes[to++] = lowest >>> 24;
    bytes[to++] = highest;
    bytes[to++] = highest >>> 8;
  }
  return wrong < 0 ? null : bytes.subarray(0, length);
}
