// A plot of the strongest reaction and of the loss over the last seconds.

const SECONDS = 10;

interface Point {
  at: number;
  reaction: number;
  loss: number | undefined;
}

export class Plot {
  #canvas: HTMLCanvasElement;
  #points: Point[] = [];

  constructor(canvas: HTMLCanvasElement) {
    this.#canvas = canvas;
  }

  push(now: number, reaction: number, loss: number | undefined): void {
    this.#points.push({ at: now, reaction, loss });
    while (this.#points.length > 4096 || this.#points[0]!.at < now - 1000 * SECONDS) this.#points.shift();
  }

  /** The strongest reaction of the last seconds, N. */
  get strongest(): number {
    return this.#points.reduce((most, point) => Math.max(most, point.reaction), 0);
  }

  draw(now: number): void {
    const canvas = this.#canvas;
    const ratio = devicePixelRatio;
    const [wide, high] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
    if (canvas.width !== Math.floor(wide)) canvas.width = Math.floor(wide);
    if (canvas.height !== Math.floor(high)) canvas.height = Math.floor(high);
    const to = canvas.getContext("2d");
    if (!to) return;
    to.clearRect(0, 0, canvas.width, canvas.height);
    const most = Math.max(this.strongest, 0.1);
    const line = (value: (point: Point) => number | undefined, color: string) => {
      to.beginPath();
      to.strokeStyle = color;
      to.lineWidth = 1.5 * ratio;
      let pen = false;
      for (const point of this.#points) {
        const y = value(point);
        const x = canvas.width * (1 - (now - point.at) / (1000 * SECONDS));
        if (y === undefined) pen = false;
        else if (pen) to.lineTo(x, (1 - 0.9 * y) * canvas.height - 1);
        else to.moveTo(x, (1 - 0.9 * y) * canvas.height - 1);
        pen = y !== undefined;
      }
      to.stroke();
    };
    line((point) => point.loss, "#e0803a");
    line((point) => point.reaction / most, "#4aa3e0");
    to.font = `${11 * ratio}px system-ui, sans-serif`;
    to.fillStyle = "#4aa3e0";
    to.fillText(`reaction, up to ${most.toPrecision(2)} N`, 6 * ratio, 14 * ratio);
    const loss = this.#points[this.#points.length - 1]?.loss;
    to.fillStyle = "#e0803a";
    to.fillText(loss === undefined ? "loss: no guests" : `loss ${(100 * loss).toFixed(1)} %`, 6 * ratio, 28 * ratio);
  }
}
