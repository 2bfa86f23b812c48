// The camera's picture as it lies on the water, laid onto the map as far as somebody wants it.

const EVERY_MS = 1000;
const AGAIN_MS = 5000;

export class Ground {
  /**
   * @param {import("/static/chart.mjs").Chart} chart The map.
   * @param {HTMLElement} label Hidden where there can be no picture.
   * @param {HTMLInputElement} slider Its opacity in percent; at 0 none is asked for.
   */
  constructor(chart, label, slider) {
    this.chart = chart;
    this.label = label;
    this.slider = slider;
    this.asking = false;
    this.replayed = false;
    slider.addEventListener("input", () => this.changed());
  }

  opacity() {
    return this.replayed ? 0 : this.slider.valueAsNumber / 100;
  }

  /** Make it more opaque by some percent, or less. */
  fade(by) {
    if (this.label.hidden) return;
    this.slider.value = this.slider.valueAsNumber + by;
    this.changed();
  }

  /** The picture is of now: what was kept is shown without. */
  replay(replayed) {
    this.replayed = replayed;
    this.changed();
  }

  changed() {
    this.slider.setAttribute("aria-valuetext", `${this.slider.value} percent`);
    this.chart.fadePicture(this.opacity());
    if (this.opacity() > 0 && !this.asking) this.ask();
  }

  async ask() {
    this.asking = true;
    let wait = EVERY_MS;
    try {
      if (!document.hidden) {
        const answer = await fetch("/api/rectified", { cache: "no-store" });
        if (answer.ok) {
          const corners = (await answer.json()).corners_deg.map(([latitude, longitude]) => [longitude, latitude]);
          await this.chart.ready;
          this.chart.setPicture(`${location.origin}/rectified.webp?at=${Date.now()}`, corners, this.opacity());
        } else wait = AGAIN_MS;
      }
    } catch {
      wait = AGAIN_MS;
    }
    setTimeout(() => {
      this.asking = false;
      if (this.opacity() > 0) this.ask();
    }, wait);
  }
}
