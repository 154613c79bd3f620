// From a detector's broker, or a camera's own stream, and the phone in a pocket to a trained camera and to Home Assistant, by
// the console alone.
import { execFileSync } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import type { Locator, Page } from '@playwright/test';
import { distance_m } from '../src/lib/geo';
import { Broker } from './broker';
import { accessibilityFindings, expect, test as base } from './fixtures';
import { RtspCamera } from './rtsp_camera';
import { BINARY, type Server } from './server';

const test = base.extend<{ broker: Broker; stream: RtspCamera }>({
  broker: async ({}, use) => {
    const broker = await Broker.start();
    await use(broker);
    broker.stop();
  },
  stream: async ({}, use) => {
    const stream = await RtspCamera.start();
    await use(stream);
    stream.stop();
  },
});

/** Size of the square's image, px. */
const [WIDTH_PX, HEIGHT_PX] = [1280, 720];

/** Recorded time after which the camera must have its model, s. */
const LEARNT_BY_S = 1200;
/** Time for which live positions are looked at, s. */
const LIVE_S = 120;
const RECORDED_S = LEARNT_BY_S + LIVE_S;
/** Time of messages that are sent at once, s. */
const SLICE_S = 20;
/** How the phone names itself; the detector knows no such name. */
const PHONE = 'anna/phone';

interface Row {
  time_ms: number;
  cells: string[];
}

interface Square {
  boxes: Row[];
  fixes: Row[];
  /** Where the one who carries the phone is, by the time in ms. */
  truth: Map<number, { longitude_deg: number; latitude_deg: number }>;
}

/** Eleven people before a camera, of whom one carries a phone; the tracker gives each another id now and then. The times end now. */
function simulateSquare(): Square {
  const folder = mkdtempSync(join(tmpdir(), 'sightfix-square-'));
  const crowd = ['--cameras', '1', '--walkers', '11', '--vehicles', '0', '--receivers', String(1 / 11), '--tracker-id-lifetime-s', '40'];
  execFileSync(BINARY, ['simulate', 'site', '--out', folder, '--duration-s', String(RECORDED_S), ...crowd], { stdio: 'ignore' });
  const rowsOf = (name: string): Row[] =>
    readFileSync(join(folder, name), 'utf8').trim().split(/\r?\n/).slice(1).map((line) => {
      const [time, ...cells] = line.split(',');
      return { time_ms: Date.parse(time!), cells };
    });
  const [boxes, fixes, truth] = [rowsOf('detections_c1.csv'), rowsOf('fixes.csv'), rowsOf('truth.csv')];
  rmSync(folder, { recursive: true });
  // Phones state whole seconds, between which these frames are.
  const end_ms = Math.floor(Date.now() / 1000) * 1000 - 750;
  const shift_ms = end_ms - boxes.at(-1)!.time_ms;
  for (const row of [...boxes, ...fixes, ...truth]) row.time_ms += shift_ms;
  // The only receiver is `phone-N` of `person-N`.
  const carrier = fixes[0]!.cells[0]!.replace('phone', 'person');
  const own = truth.filter(({ cells }) => cells[0] === carrier);
  return { boxes, fixes, truth: new Map(own.map(({ time_ms, cells }) => [time_ms, { longitude_deg: Number(cells[1]), latitude_deg: Number(cells[2]) }])) };
}

/** Where the boxes come from: what the dialog is told, and how boxes of people and cars are sent. */
interface Detector {
  button: RegExp;
  person: string;
  fill(dialog: Locator): Promise<void>;
  send(people: Row[], cars?: Row[]): void;
}

const frigate = (broker: Broker): Detector => ({
  button: /^Frigate/,
  person: 'person',
  fill: async (dialog) => {
    await dialog.getByLabel(/^Address/).fill(broker.address);
    await dialog.getByLabel(/^Name of the camera/).fill('front_door');
  },
  send: (people, cars = []) => broker.publish('frigate/events', [...people.map((row) => frigateEvent(row, 'person')), ...cars.map((row) => frigateEvent(row, 'car'))]),
});

const onvif = (stream: RtspCamera): Detector => ({
  button: /^ONVIF camera/,
  person: 'Human',
  fill: async (dialog) => {
    await dialog.getByLabel(/^Address/).fill(stream.address);
    await dialog.getByLabel('User', { exact: true }).fill(stream.user);
    await dialog.getByLabel('Password').fill(stream.password);
  },
  send: (people, cars = []) => {
    const frames = new Map<number, (Row & { label: string })[]>();
    for (const row of [...people.map((it) => ({ ...it, label: 'Human' })), ...cars.map((it) => ({ ...it, label: 'Vehicle' }))]) frames.set(row.time_ms, [...(frames.get(row.time_ms) ?? []), row]);
    stream.send([...frames].map(([time_ms, rows]) => onvifFrame(time_ms, rows)));
  },
});

/** A frame of ONVIF metadata in pixels, with the elements that Hanwha's cameras have. */
function onvifFrame(time_ms: number, rows: (Row & { label: string })[]): string {
  const objects = rows.map(({ cells: [id, left, top, width, height], label }) => {
    const [right, bottom] = [Number(left) + Number(width), Number(top) + Number(height)];
    return `<tt:Object ObjectId="${id}" Parent="0"><tt:Appearance><tt:Shape><tt:BoundingBox left="${left}" top="${top}" right="${right}" bottom="${bottom}"/></tt:Shape><tt:Class><tt:Type Likelihood="0.88">${label}</tt:Type></tt:Class></tt:Appearance></tt:Object>`;
  });
  const transformation = `<tt:Transformation><tt:Translate x="-1" y="1"/><tt:Scale x="${2 / WIDTH_PX}" y="${-2 / HEIGHT_PX}"/></tt:Transformation>`;
  return `<tt:MetadataStream xmlns:tt="http://www.onvif.org/ver10/schema"><tt:VideoAnalytics><tt:Frame UtcTime="${new Date(time_ms).toISOString()}">${transformation}${objects.join('')}</tt:Frame></tt:VideoAnalytics></tt:MetadataStream>`;
}

/** An event of Frigate with the state after a change. */
function frigateEvent({ time_ms, cells: [id, left, top, width, height] }: Row, label: string): string {
  const [x, y] = [Number(left), Number(top)];
  const box = [x, y, x + Number(width), y + Number(height)];
  return JSON.stringify({ type: 'update', before: {}, after: { id: `1607123955.475377-${id}`, camera: 'front_door', label, false_positive: false, frame_time: time_ms / 1000, score: 0.88, box } });
}

/** What an application was told to set, by the names of the settings. */
async function settingsOf(dialog: Locator): Promise<Record<string, string>> {
  const [names, values] = [await dialog.locator('dt').allTextContents(), await dialog.locator('dd').allTextContents()];
  return Object.fromEntries(names.map((name, at) => [name, values[at]!]));
}

const step = (page: Page, name: RegExp): Locator => page.getByRole('listitem').filter({ has: page.getByRole('heading', { name }) });

test('one phone among eleven people trains a camera of Frigate, and Home Assistant follows it', async ({ console: page, server, broker }) => {
  await learnAndFollow(page, server, broker, frigate(broker));
});

test('one phone among eleven people trains an ONVIF camera of RTSP, and Home Assistant follows it', async ({ console: page, server, broker, stream }) => {
  await learnAndFollow(page, server, broker, onvif(stream));
});

async function learnAndFollow(page: Page, server: Server, broker: Broker, detector: Detector): Promise<void> {
  // Training runs at the lowest priority: on a busy machine it takes as long as it takes.
  test.setTimeout(1_800_000);
  const square = simulateSquare();
  const begin_ms = square.boxes[0]!.time_ms;
  const within = (from_s: number, until_s: number) => ({ time_ms }: Row): boolean => time_ms >= begin_ms + from_s * 1000 && time_ms < begin_ms + until_s * 1000;
  const { secret } = await server.request<{ secret: string }>('POST', '/v1/keys', { name: 'first', role: 'admin', camera_ids: [] });
  await page.goto('about:blank');
  await page.context().request.post(`${server.url}/v1/session`, { data: { key: secret } });
  await page.goto(server.url);

  // The camera, by its detector.
  await page.getByRole('button', { name: 'Add camera' }).first().click();
  const dialog = page.getByRole('dialog');
  expect(await accessibilityFindings(page)).toEqual([]);
  await dialog.getByRole('button', { name: detector.button }).click();
  await dialog.getByLabel('Name', { exact: true }).fill('Square');
  await detector.fill(dialog);
  await dialog.getByLabel('Image width, px').fill(String(WIDTH_PX));
  await dialog.getByLabel('Image height, px').fill(String(HEIGHT_PX));
  expect(await accessibilityFindings(page)).toEqual([]);
  await dialog.getByRole('button', { name: 'Connect and look at the boxes' }).click();
  const boxes = step(page, /See the boxes/);
  await expect(boxes.getByText('Running')).toBeVisible();

  // Its boxes as they come, of people alone.
  const some = square.boxes.filter(within(0, 5));
  const parked = some.map((row) => ({ ...row, cells: ['parked', '900', '500', '200', '120'] }));
  await expect(async () => {
    // The page may only just begin to listen.
    detector.send(some, parked);
    await expect(boxes.getByRole('img', { name: /Picture with [1-9]\d* boxes/ })).toBeVisible({ timeout: 2000 });
  }).toPass();
  await boxes.getByRole('button', { name: detector.person, exact: true }).click();
  await boxes.getByRole('button', { name: 'Save the filter' }).click();
  await expect(page.getByText('The filter is saved')).toBeVisible();
  await boxes.getByRole('button', { name: /start learning/ }).click();
  await expect(page.getByText('No box with a tracker’s id has come yet')).toBeVisible();

  // The phone, with what its application is told.
  await step(page, /Connect a phone/).getByRole('button', { name: 'Add phone' }).click();
  const phone = page.getByRole('dialog', { name: 'Add phone' });
  await phone.getByLabel('Application').selectOption({ label: 'OwnTracks' });
  await phone.getByRole('button', { name: 'Make the settings' }).click();
  await expect(phone.locator('dl')).toBeVisible();
  const settings = await settingsOf(phone);
  const authorization = `Basic ${Buffer.from(`${settings.User}:${settings.Password}`).toString('base64')}`;
  const sendFix = async ({ time_ms, cells: [, longitude, latitude] }: Row): Promise<void> => {
    const location = { _type: 'location', topic: `owntracks/${PHONE}`, tst: Math.round(time_ms / 1000), lon: Number(longitude), lat: Number(latitude), acc: 4 };
    const answer = await fetch(settings.URL!, { method: 'POST', headers: { authorization, 'content-type': 'application/json' }, body: JSON.stringify(location) });
    expect(answer.status).toBe(200);
  };
  await page.keyboard.press('Escape');

  const learning = async (): Promise<{ state: string; boxes: number; fixes: number; recorded_s: number; needed_s: number }> =>
    (await page.context().request.get(`${server.url}/v1/cameras/square/learning`)).json();
  /** What camera and phone send from a time up to another, s. */
  const send = async (from_s: number, until_s: number, slice_s: number, pause_ms = 0): Promise<void> => {
    for (let at_s = from_s; at_s < until_s; at_s += slice_s) {
      const isOfSlice = within(at_s, Math.min(at_s + slice_s, until_s));
      detector.send(square.boxes.filter(isOfSlice));
      // Fixes are recorded from the first box on, which comes by another way.
      if (at_s === 0) await expect.poll(async () => (await learning()).boxes).toBeGreaterThan(0);
      for (const fix of square.fixes.filter(isOfSlice)) await sendFix(fix);
      await page.waitForTimeout(pause_ms);
    }
  };
  await send(0, 240, SLICE_S);
  await expect(page.getByText(/^[34] of about 8 minutes with boxes and fixes/)).toBeVisible();
  await expect(step(page, /Connect a phone/).getByRole('list', { name: 'Latest fixes' })).toContainText(`${PHONE} within`);
  expect(await accessibilityFindings(page)).toEqual([]);

  // The page may be left, and says where one was.
  await page.goto(`${server.url}/#/cameras`);
  await page.getByText('Square').first().click();
  await page.getByRole('link', { name: 'Set up' }).first().click();
  await expect(step(page, /Walk and wait/)).toHaveAttribute('aria-current', 'step');
  // An attempt that finds nothing is followed by one with more.
  let learnt_s = 240;
  for (;;) {
    const now = await learning();
    const sent = (rows: Row[]): number => rows.filter(within(0, learnt_s)).length;
    const isRecorded = now.boxes === sent(square.boxes) && now.fixes === sent(square.fixes);
    if (now.state === 'learned') break;
    if (now.state === 'recording' && now.recorded_s < now.needed_s && isRecorded) {
      expect(learnt_s).toBeLessThan(LEARNT_BY_S);
      await send(learnt_s, learnt_s + SLICE_S, SLICE_S);
      learnt_s += SLICE_S;
    } else await page.waitForTimeout(200);
  }
  await expect(page.getByText('Model version 1 answers.')).toBeVisible();
  await expect(step(page, /Live positions/)).toHaveAttribute('aria-current', 'step');

  // Live, and the same in Home Assistant.
  const messages = await broker.subscribe(['homeassistant/#', 'sightfix/#', 'sightfix-availability/#']);
  await page.getByRole('button', { name: 'Send positions to another system' }).click();
  const sink = page.getByRole('dialog', { name: 'Send positions to another system' });
  await sink.getByRole('button', { name: 'Home Assistant (MQTT)' }).click();
  await sink.getByLabel(/^Address/).fill(broker.address);
  await sink.getByLabel(/^Least time/).fill('0');
  await sink.getByRole('button', { name: 'Connect' }).click();
  await expect(step(page, /Live positions/).getByText('Running')).toBeVisible();
  await page.getByRole('link', { name: 'Look at live positions' }).click();
  // A position that a newer one replaces before it is published is not sent: small slices leave time for each.
  await send(learnt_s, learnt_s + LIVE_S, 1, 300);
  await expect(page.getByRole('button', { name: PHONE })).toBeVisible();

  const topic = 'sightfix/square/anna_phone';
  const configurations = messages.filter(([name]) => name.startsWith('homeassistant/'));
  expect(configurations.map(([name]) => name)).toEqual(['homeassistant/device_tracker/sightfix_square_anna_phone/config']);
  expect(JSON.parse(configurations[0]![1])).toMatchObject({ name: PHONE, source_type: 'gps', json_attributes_topic: topic, availability_topic: 'sightfix-availability/home-assistant-mqtt' });
  expect(messages.find(([name]) => name.startsWith('sightfix-availability/'))?.[1]).toBe('online');
  const positions = messages.filter(([name]) => name === topic).map(([, payload]) => JSON.parse(payload) as { time: string; longitude: number; latitude: number; gps_accuracy: number });
  expect(messages.filter(([name]) => name.startsWith('sightfix/')).length, 'nobody else is announced').toBe(positions.length);
  // Fixes have times of whole seconds, boxes those of frames: only the former could come from the phone alone.
  const frames = new Set(square.boxes.map(({ time_ms }) => time_ms));
  const ofBoxes = positions.filter(({ time }) => frames.has(Date.parse(time)));
  const errors_m = ofBoxes.flatMap(({ time, longitude, latitude }) => {
    const truth = square.truth.get(Date.parse(time));
    return truth ? [distance_m(truth, { longitude_deg: longitude, latitude_deg: latitude })] : [];
  });
  const mean_m = errors_m.reduce((sum, error) => sum + error, 0) / errors_m.length;
  console.log(`${positions.length} positions in Home Assistant, ${ofBoxes.length} of boxes after ${learnt_s} s, ${mean_m.toFixed(2)} m from the truth on average`);
  expect(errors_m.length).toBeGreaterThan(30);
  // The phone alone is off by 2.6 m per axis, which is 3.3 m on average.
  expect(mean_m).toBeLessThan(2.5);
}
