// Pixels of the picture, eight times as large: one of them counts at the lower edge.

import { sharpContext } from "/static/canvas.mjs";

const TIMES = 8;

/**
 * Draw a part of a picture.
 *
 * @param {HTMLCanvasElement} canvas What is drawn on.
 * @param {{bitmap: ImageBitmap, crop: object | null}} picture The whole picture, and a part of it
 *   without the losses of its compression, where that is there already.
 * @param {number[]} middle The pixel in the middle.
 * @param {{box?: number[] | null, point?: number[] | null}} marks What is drawn over it.
 */
export function magnify(canvas, { bitmap, crop }, middle, { box = null, point = null } = {}) {
  const context = sharpContext(canvas);
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  context.fillStyle = "#000000";
  context.fillRect(0, 0, w, h);
  if (!bitmap || !middle) return;
  const [left, top] = [middle[0] - w / 2 / TIMES, middle[1] - h / 2 / TIMES];
  const at = (x, y) => [(x - left) * TIMES, (y - top) * TIMES];
  context.imageSmoothingEnabled = false;
  // Whole pixels alone are asked for: parts of them are drawn blurred.
  const [x0, y0] = [Math.max(0, Math.floor(left)), Math.max(0, Math.floor(top))];
  const x1 = Math.min(bitmap.width, Math.ceil(left + w / TIMES));
  const y1 = Math.min(bitmap.height, Math.ceil(top + h / TIMES));
  if (x1 > x0 && y1 > y0) {
    context.drawImage(
      bitmap, x0, y0, x1 - x0, y1 - y0, ...at(x0, y0), (x1 - x0) * TIMES, (y1 - y0) * TIMES,
    );
  }
  if (crop) {
    context.drawImage(
      crop.bitmap, ...at(crop.x, crop.y), crop.bitmap.width * TIMES, crop.bitmap.height * TIMES,
    );
  }
  const stroke = (path) => {
    for (const [style, line] of [["rgba(0, 0, 0, 0.7)", 3], ["#ffffff", 1]]) {
      context.strokeStyle = style;
      context.lineWidth = line;
      context.beginPath();
      path();
      context.stroke();
    }
  };
  if (box) {
    const [bx1, by1] = at(box[0], box[1]);
    const [bx2, by2] = at(box[2], box[3]);
    stroke(() => context.rect(bx1, by1, bx2 - bx1, by2 - by1));
    // The edge that counts.
    context.strokeStyle = "#f0a030";
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(Math.max(bx1, 0), by2);
    context.lineTo(Math.min(bx2, w), by2);
    context.stroke();
  }
  if (point) {
    const [px, py] = at(point[0], point[1]);
    stroke(() => {
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(px + 3 * dx, py + 3 * dy);
        context.lineTo(px + 24 * dx, py + 24 * dy);
      }
    });
  }
}

export { TIMES };
