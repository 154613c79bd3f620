// Drawing on both planes, as plain functions of a canvas: tested by their calls.

import type { Covariance } from './types';

export interface Pixel {
  x: number;
  y: number;
}

/** Half axes in metres and the angle of the first, anticlockwise from east. */
export interface Ellipse {
  a_m: number;
  b_m: number;
  angle_rad: number;
}

/** The 95 % ellipse of a covariance that the server states. */
export function ellipse95({ east_m2, north_m2, east_north_m2 }: Covariance): Ellipse {
  return ellipseOf(east_m2, north_m2, east_north_m2);
}

/** The 95 % ellipse of a horizontal covariance, m2. */
export function ellipseOf(east_m2: number, north_m2: number, cross_m2: number): Ellipse {
  const mean = (east_m2 + north_m2) / 2;
  const spread = Math.hypot((east_m2 - north_m2) / 2, cross_m2);
  const scale = Math.sqrt(-2 * Math.log(0.05));
  return {
    a_m: scale * Math.sqrt(mean + spread),
    b_m: scale * Math.sqrt(Math.max(mean - spread, 0)),
    angle_rad: 0.5 * Math.atan2(2 * cross_m2, east_m2 - north_m2),
  };
}

/** Directions over a quarter turn in which the density of an error is summed. */
const QUADRANT_STEPS = 64;

/** The radius about the mean that holds the true position with 95 % probability, m, for a horizontal covariance, m2. */
export function r95Of({ east_m2, north_m2, east_north_m2 }: Covariance): number {
  const mean = (east_m2 + north_m2) / 2;
  const spread = Math.hypot((east_m2 - north_m2) / 2, east_north_m2);
  const major_m2 = mean + spread;
  // A narrower ellipse has the same radius within 0.1 %, and too sharp a peak for the sum.
  const minor_m2 = Math.max(mean - spread, major_m2 / 400);
  // In polar coordinates about the mean, the density along a ray integrates to (1 - exp(-r² q / 2)) / q.
  const outside = (radius_m: number): number => {
    let sum = 0;
    for (let step = 0; step < QUADRANT_STEPS; step++) {
      const angle = ((step + 0.5) / QUADRANT_STEPS) * (Math.PI / 2);
      const q = Math.cos(angle) ** 2 / major_m2 + Math.sin(angle) ** 2 / minor_m2;
      sum += Math.exp((-radius_m * radius_m * q) / 2) / q;
    }
    return sum / QUADRANT_STEPS / Math.sqrt(major_m2 * minor_m2);
  };
  let [low, high] = [0, 3 * Math.sqrt(major_m2)];
  for (let halving = 0; halving < 40; halving++) {
    const middle = (low + high) / 2;
    if (outside(middle) > 0.05) low = middle;
    else high = middle;
  }
  return high;
}

export type Context = CanvasRenderingContext2D;

export interface Style {
  stroke?: string;
  fill?: string;
  width?: number;
  dash?: number[];
}

function paint(context: Context, { stroke, fill, width = 1.5, dash }: Style): void {
  if (fill) {
    context.fillStyle = fill;
    context.fill();
  }
  if (stroke) {
    context.setLineDash(dash ?? []);
    context.lineWidth = width;
    context.strokeStyle = stroke;
    context.stroke();
  }
}

export function drawEllipse(context: Context, at: Pixel, ellipse: Ellipse, px_per_m: number, style: Style): void {
  context.beginPath();
  // The canvas' y axis points down, so a rotation towards north is negative.
  context.ellipse(at.x, at.y, ellipse.a_m * px_per_m, ellipse.b_m * px_per_m, -ellipse.angle_rad, 0, 2 * Math.PI);
  paint(context, style);
}

export function drawCircle(context: Context, at: Pixel, radius_px: number, style: Style): void {
  context.beginPath();
  context.arc(at.x, at.y, radius_px, 0, 2 * Math.PI);
  paint(context, style);
}

export function drawPolygon(context: Context, corners: Pixel[], style: Style): void {
  if (corners.length < 2) return;
  context.beginPath();
  corners.forEach(({ x, y }, at) => (at === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
  context.closePath();
  paint(context, style);
}

/** Lines, or the rings of polygons with holes, as one path. */
export function drawPath(context: Context, parts: Pixel[][], isClosed: boolean, style: Style): void {
  context.beginPath();
  for (const part of parts) {
    part.forEach(({ x, y }, at) => (at === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
    if (isClosed) context.closePath();
  }
  paint(context, style);
}

export function drawLine(context: Context, from: Pixel, to: Pixel, style: Style): void {
  context.beginPath();
  context.moveTo(from.x, from.y);
  context.lineTo(to.x, to.y);
  paint(context, style);
}

/** A trail that fades towards its oldest point; the last point is the newest. */
export function drawTrail(context: Context, points: Pixel[], color: string, width = 2): void {
  for (let at = 1; at < points.length; at++) {
    context.globalAlpha = 0.12 + 0.78 * (at / points.length);
    drawLine(context, points[at - 1]!, points[at]!, { stroke: color, width });
  }
  context.globalAlpha = 1;
}

export function drawRectangle(context: Context, x: number, y: number, width: number, height: number, style: Style): void {
  context.beginPath();
  context.rect(x, y, width, height);
  paint(context, style);
}

/** A text in the colour of texts with a halo, so that it can be read on whatever is under it. */
export function drawLabel(context: Context, text: string, at: Pixel, colors: Palette, align: CanvasTextAlign = 'left'): void {
  context.font = '500 12px "Plex Sans", sans-serif';
  context.textAlign = align;
  context.lineWidth = 3.5;
  context.lineJoin = 'round';
  context.setLineDash([]);
  context.strokeStyle = colors.plane;
  context.fillStyle = colors.text;
  context.strokeText(text, at.x, at.y);
  context.fillText(text, at.x, at.y);
}

/** Sizes a canvas to its element in device pixels; returns the context in CSS pixels, cleared. */
export function prepare(canvas: HTMLCanvasElement, width: number, height: number): Context {
  const ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext('2d')!;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return context;
}

const RAMP = [
  [55, 120, 190],
  [55, 190, 170],
  [240, 200, 80],
  [236, 100, 70],
] as const;

/** A colour from cold (0) to hot (1). */
export function rampColor(value: number): string {
  const at = Math.min(Math.max(value, 0), 1) * (RAMP.length - 1);
  const from = RAMP[Math.min(Math.floor(at), RAMP.length - 2)]!;
  const to = RAMP[Math.min(Math.floor(at), RAMP.length - 2) + 1]!;
  const share = at - Math.min(Math.floor(at), RAMP.length - 2);
  const [r, g, b] = from.map((low, channel) => Math.round(low + (to[channel]! - low) * share));
  return `rgb(${r} ${g} ${b})`;
}

/** The colours of the theme, for canvases. */
export interface Palette {
  text: string;
  muted: string;
  grid: string;
  gridStrong: string;
  plane: string;
  camera: string;
  gnss: string;
  fused: string;
  accent: string;
  danger: string;
  warning: string;
}

export function palette(): Palette {
  const style = getComputedStyle(document.documentElement);
  const read = (name: string): string => style.getPropertyValue(name).trim();
  return {
    text: read('--text'),
    muted: read('--muted'),
    grid: read('--grid'),
    gridStrong: read('--grid-strong'),
    plane: read('--plane'),
    camera: read('--camera'),
    gnss: read('--gnss'),
    fused: read('--fused'),
    accent: read('--accent'),
    danger: read('--danger'),
    warning: read('--warning'),
  };
}

/** A colour with an opacity from 0 to 1. */
export function fade(color: string, opacity: number): string {
  return `color-mix(in srgb, ${color} ${Math.round(opacity * 100)}%, transparent)`;
}
