// A canvas over a Leaflet map: the metric grid, and whatever a view draws.
import type * as L from 'leaflet';
import { drawLine, palette, prepare, type Context, type Palette, type Pixel } from './draw';
import { metresPerPixel, roundLength } from './geo';
import type { Position } from './types';

/** The canvas that a view draws on. */
export interface PlaneView {
  context: Context;
  colors: Palette;
  px_per_m: number;
  width: number;
  height: number;
  at: (position: Position) => Pixel;
  /** The square of the web's Mercator projection, of which the view shows a part. */
  world: { left_px: number; top_px: number; size_px: number };
}

export type Draw = (view: PlaneView) => void;

const GRID_TARGET_PX = 110;

export class PlaneLayer {
  readonly canvas = document.createElement('canvas');
  readonly #leaflet: typeof L;
  readonly #map: L.Map;
  readonly #hasGrid: boolean;
  #draw: Draw = () => {};
  #frame = 0;
  #isClosed = false;

  /** The class names its canvas in style sheets. */
  constructor(leaflet: typeof L, map: L.Map, className: string, hasGrid: boolean) {
    this.#leaflet = leaflet;
    this.#map = map;
    this.#hasGrid = hasGrid;
    this.canvas.className = className;
    map.getPanes().overlayPane.append(this.canvas);
    map.on('move zoom viewreset resize', () => this.redraw());
  }

  set draw(draw: Draw) {
    this.#draw = draw;
    this.redraw();
  }

  /** Metres in a CSS pixel at the middle of the view. */
  metresPerPixel(): number {
    return metresPerPixel((this.#map.getCenter().lat * Math.PI) / 180, this.#map.getZoom());
  }

  redraw(): void {
    cancelAnimationFrame(this.#frame);
    if (this.#isClosed) return;
    this.#frame = requestAnimationFrame(() => this.#paint());
  }

  /** Draws no more: a frame that was asked for before the map is removed would meet a map without panes. */
  close(): void {
    cancelAnimationFrame(this.#frame);
    this.#isClosed = true;
  }

  #paint(): void {
    const { x: width, y: height } = this.#map.getSize();
    if (width === 0 || height === 0) return;
    const corner = this.#map.containerPointToLayerPoint([0, 0]);
    this.#leaflet.DomUtil.setPosition(this.canvas, corner);
    this.canvas.style.width = `${width}px`;
    this.canvas.style.height = `${height}px`;
    const context = prepare(this.canvas, width, height);
    const colors = palette();
    const at = ({ longitude_deg, latitude_deg }: Position): Pixel =>
      this.#map.latLngToContainerPoint([latitude_deg, longitude_deg]);
    const px_per_m = 1 / this.metresPerPixel();
    const origin = this.#map.project(this.#map.getCenter()).subtract([width / 2, height / 2]);
    const world = { left_px: -origin.x, top_px: -origin.y, size_px: 256 * 2 ** this.#map.getZoom() };
    if (this.#hasGrid) this.#grid(context, colors, px_per_m, width, height, origin);
    this.#draw({ context, colors, px_per_m, width, height, at, world });
  }

  /** Lines of a round distance, counted from a corner that does not move with the view. */
  #grid(context: Context, colors: Palette, px_per_m: number, width: number, height: number, origin: Pixel): void {
    const step_px = roundLength((GRID_TARGET_PX * 1.6) / px_per_m) * px_per_m;
    for (const [offset, length, vertical] of [
      [origin.x, width, true],
      [origin.y, height, false],
    ] as const) {
      const first = Math.ceil(offset / step_px);
      for (let line = first; line * step_px - offset <= length; line++) {
        const p = Math.round(line * step_px - offset) + 0.5;
        const style = { stroke: line % 5 === 0 ? colors.gridStrong : colors.grid, width: 1 };
        if (vertical) drawLine(context, { x: p, y: 0 }, { x: p, y: height }, style);
        else drawLine(context, { x: 0, y: p }, { x: width, y: p }, style);
      }
    }
  }
}
