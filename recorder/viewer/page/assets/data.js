"use strict";
// Reading of packed data; packed.py describes the bytes.

const ARRAYS = { uint8: Uint8Array, int32: Int32Array, float32: Float32Array, float64: Float64Array };

/** Return the value in packed bytes. Arrays get the property `shape`. */
async function unpack(bytes) {
  const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(inflated).arrayBuffer();
  const length = new DataView(buffer).getUint32(0, true);
  const start = Math.ceil((4 + length) / 8) * 8;
  return JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)), (key, value) => {
    if (value === null || !Object.hasOwn(value, "dtype")) return value;
    const count = value.shape.reduce((product, size) => product * size, 1);
    return Object.assign(new ARRAYS[value.dtype](buffer, start + value.at, count), { shape: value.shape });
  });
}

/** Return the bytes of the base64 text in an element; null if it is empty. */
function embedded(id) {
  const text = document.getElementById(id).textContent;
  return text ? Uint8Array.from(atob(text), (character) => character.charCodeAt(0)) : null;
}

/** Return row k of an array of two or more dimensions. */
function row(array, k) {
  const size = array.length / (array.shape[0] || 1);
  return array.subarray(k * size, (k + 1) * size);
}

/** Return the index of the last element of a sorted array that is at most `value`; -1 if there is none. */
function indexAt(sorted, value) {
  let low = 0, high = sorted.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] <= value) low = middle + 1; else high = middle;
  }
  return low - 1;
}

/** Return a number as short text. */
function short(number) {
  return Number.isFinite(number) ? String(Number(number.toPrecision(4))) : "\u2013";
}

/** Create an element with properties and children. Texts become text nodes, never HTML. */
function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}
