// Numbers as people write them: as many digits as the standard deviation leaves.

function formatNumber(value, sd, unit) {
  const decimals = countDecimals(value, sd);
  const written = write(value, decimals);
  const isFullTurn = unit === "\u00b0" && Number(written) === 360; // directions are in [0, 360)
  return { value: isFullTurn ? write(0, decimals) : written, sd: sd === null || sd === undefined ? null : write(sd, decimals) };
}

// Fewer than none: rounded to tens, hundreds and so on.
function countDecimals(value, sd) {
  if (sd > 0) return clamp(1 - Math.floor(Math.log10(sd)), -8, 8);
  if (Number.isInteger(value)) return 0;
  return clamp(2 - Math.floor(Math.log10(Math.abs(value))), 0, 8);
}

function write(value, decimals) {
  const step = 10 ** Math.max(-decimals, 0);
  const written = decimals > 0 ? value.toFixed(decimals) : String(Math.round(value / step) * step);
  return (Number(written) === 0 ? written.replace("-", "") : written).replace("-", "\u2212");
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

// "1234 ± 56 mm²"
function formatTrait(number, unit) {
  const text = formatNumber(number.value, number.sd, unit);
  const sd = text.sd === null ? "" : ` \u00b1 ${text.sd}`;
  return text.value + sd + (unit === "" ? "" : unit === "\u00b0" ? unit : ` ${unit}`);
}

function count(number, noun, nouns = `${noun}s`) {
  return `${number} ${number === 1 ? noun : nouns}`;
}
