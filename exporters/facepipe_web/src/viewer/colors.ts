/** Colours of regions and of distances, the same as in facepipe's own pictures. */

/** Eleven sRGB stations of viridis (CC0). */
export const VIRIDIS = [
  [68, 1, 84], [72, 36, 117], [65, 68, 135], [53, 95, 141], [42, 120, 142], [33, 144, 141],
  [34, 168, 132], [68, 191, 112], [122, 209, 81], [189, 223, 38], [253, 231, 37],
];

/** Okabe and Ito's colours without black, then some that colour-blind readers see as others. */
const PALETTE = [
  [230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66], [0, 114, 178], [213, 94, 0],
  [204, 121, 167], [119, 0, 34], [119, 255, 255], [68, 34, 136], [0, 0, 255], [119, 85, 102],
];
export const NO_REGION = [140, 140, 140];

/** sRGB of region `number`; beyond the palette darker and lighter rounds of it. */
export function regionColor(number: number): number[] {
  const round = Math.floor(number / PALETTE.length);
  const share = 1 - 0.6 ** Math.floor((round + 1) / 2);
  const target = round % 2 ? 0 : 255;
  return PALETTE[number % PALETTE.length].map((level) => level * (1 - share) + target * share);
}

export function css(color: number[]): string {
  return `rgb(${color.map(Math.round).join(" ")})`;
}

/** sRGB 0..255 -> linear 0..1. */
export function linear(color: number[]): number[] {
  return color.map((level) => (level / 255 <= 0.04045 ? level / 255 / 12.92 : ((level / 255 + 0.055) / 1.055) ** 2.4));
}
