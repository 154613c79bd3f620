// An image that is stretched over four corners of a Leaflet map, and handles that drag them.
import type * as L from 'leaflet';
import type { Pixel } from './draw';
import type { Corners } from './georeference';
import { Handles } from './handles';

/** The transformation of CSS that puts a rectangle's corners onto four points, in the order of [`Corners`]. */
export function matrixOf(width_px: number, height_px: number, [p0, p1, p2, p3]: [Pixel, Pixel, Pixel, Pixel]): string {
  // Heckbert, Fundamentals of Texture Mapping and Image Warping, 1989: from the unit square to a quadrilateral.
  const [dx1, dx2, dx3] = [p1.x - p2.x, p3.x - p2.x, p0.x - p1.x + p2.x - p3.x];
  const [dy1, dy2, dy3] = [p1.y - p2.y, p3.y - p2.y, p0.y - p1.y + p2.y - p3.y];
  const determinant = dx1 * dy2 - dx2 * dy1;
  const g = (dx3 * dy2 - dx2 * dy3) / determinant;
  const h = (dx1 * dy3 - dx3 * dy1) / determinant;
  const [a, b] = [p1.x - p0.x + g * p1.x, p3.x - p0.x + h * p3.x];
  const [d, e] = [p1.y - p0.y + g * p1.y, p3.y - p0.y + h * p3.y];
  const columns = [
    [a / width_px, d / width_px, 0, g / width_px],
    [b / height_px, e / height_px, 0, h / height_px],
    [0, 0, 1, 0],
    [p0.x, p0.y, 0, 1],
  ];
  return `matrix3d(${columns.flat().join(',')})`;
}

export class AerialLayer {
  readonly #map: L.Map;
  readonly #image = document.createElement('img');
  readonly #handles: Handles;
  readonly #place = (): void => this.#stretch();
  #corners: Corners | undefined;

  constructor(leaflet: typeof L, map: L.Map) {
    this.#map = map;
    this.#handles = new Handles(leaflet, map);
    this.#image.className = 'aerial';
    this.#image.alt = '';
    this.#image.addEventListener('load', this.#place);
    // Under everything that views draw, above tiles.
    map.getPanes().overlayPane.prepend(this.#image);
    map.on('zoom viewreset', this.#place);
  }

  show(url: string, corners: Corners | undefined): void {
    if (this.#image.getAttribute('src') !== url) this.#image.src = url;
    this.#image.hidden = !corners;
    this.#corners = corners;
    this.#stretch();
  }

  /** Shows a handle at each corner; `onmove` gets the corners while one is dragged, and when it is let go. */
  adjust(labels: readonly string[], onmove: (corners: Corners, isDone: boolean) => void): void {
    this.#handles.show(this.#corners ?? [], labels, (at, position, isDone) => {
      onmove(this.#corners!.map((old, index) => (index === at ? position : old)) as Corners, isDone);
    });
  }

  /** Removes the handles. */
  settle(): void {
    this.#handles.clear();
  }

  close(): void {
    this.settle();
    this.#map.off('zoom viewreset', this.#place);
    this.#image.remove();
  }

  #stretch(): void {
    const { naturalWidth: width_px, naturalHeight: height_px } = this.#image;
    if (!this.#corners || width_px === 0) return;
    const points = this.#corners.map(({ latitude_deg, longitude_deg }) => this.#map.latLngToLayerPoint([latitude_deg, longitude_deg]));
    this.#image.style.transform = matrixOf(width_px, height_px, points as unknown as [Pixel, Pixel, Pixel, Pixel]);
  }
}
