"use strict";
// Image observations, and depth images in colors from blue (near) to red (far).

class ImageView {
  constructor(parent, image) {
    this.image = image;
    const [, height, width, channels] = image.pixels.shape;
    this.channels = channels;
    this.canvas = element("canvas", { width, height });
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", image.title);
    const every = image.steps.length > 1 ? image.steps[1] - image.steps[0] : 1;
    const title = image.title + (every > 1 ? `; every ${every} steps` : "");
    parent.append(element("div", { className: "panel" }, element("h2", { textContent: title }), this.canvas));
  }

  /** Show the latest image up to a step. */
  draw(step) {
    const { steps, pixels, is_depth: isDepth } = this.image;
    const index = Math.max(0, indexAt(steps, step));
    if (index === this.index) return;
    this.index = index;
    const context = this.canvas.getContext("2d"), source = row(pixels, index), { channels } = this;
    const target = context.createImageData(this.canvas.width, this.canvas.height);
    for (let from = 0, to = 0; to < target.data.length; from += channels, to += 4) {
      const color = isDepth ? DEPTH_COLORS[source[from]]
        : channels < 3 ? [source[from], source[from], source[from]]
        : source.subarray(from, from + 3);
      target.data.set(color, to);
      target.data[to + 3] = 255;
    }
    context.putImageData(target, 0, 0);
  }
}

// Polynomials of the color map Turbo by A. Mikhailov, "Turbo, an improved rainbow colormap", 2019.
const TURBO = [
  [0.13572138, 4.6153926, -42.66032258, 132.13108234, -152.94239396, 59.28637943],
  [0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604],
  [0.1066733, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973],
];
// Color of each number of a depth image; 0 is unknown and black, so the dark end of the map is left out.
const DEPTH_COLORS = Array.from({ length: 256 }, (_, code) => {
  const share = 0.07 + 0.93 * (code - 1) / 254;
  return TURBO.map((factors) => code && 255 * factors.reduceRight((sum, factor) => sum * share + factor, 0));
});
