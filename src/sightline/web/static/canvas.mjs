// A canvas as sharp as the screen.

/**
 * Make a canvas as large as it is shown, and draw in the pixels of the page from then on.
 *
 * @param {HTMLCanvasElement} canvas What is drawn on.
 */
export function sharpContext(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [
    Math.max(1, Math.round(canvas.clientWidth * ratio)),
    Math.max(1, Math.round(canvas.clientHeight * ratio)),
  ];
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return context;
}
