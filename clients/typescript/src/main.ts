// Creates a camera, imports samples, trains, fuses and tracks with a client that is generated from the OpenAPI
// description, and checks every response against the description.
//
// usage: node dist/main.js SERVER OPENAPI TRAINING_CSV

import { readFileSync } from "node:fs";
import createClient from "openapi-fetch";
import type { components, paths } from "./schema.js";
import { Description } from "./validation.js";

type TrainingRun = components["schemas"]["TrainingRun"];
type Evaluation = components["schemas"]["Evaluation"];
type Observation = components["schemas"]["Observation"];
type Problem = components["schemas"]["Problem"];

const [server, openapi, training] = process.argv.slice(2);
if (server === undefined || openapi === undefined || training === undefined) {
  throw new Error("usage: main.js SERVER OPENAPI TRAINING_CSV");
}

const description = new Description(openapi);
const client = createClient<paths>({ baseUrl: server });
client.use(description.middleware());

const camera = "square";
const path = { camera };
const text = { bodySerializer: (body: unknown) => String(body) };

/** The JSON body of a success. */
function body<T>(answer: { data?: T; error?: Problem | undefined; response: Response }): Exclude<T, string> {
  const { data, error, response } = answer;
  if (data === undefined || typeof data === "string") {
    throw new Error(`${response.url}: ${response.status} ${error?.title}: ${error?.detail}`);
  }
  return data as Exclude<T, string>;
}

/** Checks a value. */
function expect(condition: boolean, what: string): void {
  if (!condition) throw new Error(what);
}

/** Reads a job until it has ended. */
async function ended<Job extends TrainingRun | Evaluation>(read: () => Promise<Job>): Promise<Job> {
  for (;;) {
    const job = await read();
    if (job.state === "succeeded") return job;
    if (job.state === "failed" || job.state === "cancelled") throw new Error(`${job.state}: ${job.outcome}`);
    await new Promise((resolve) => setTimeout(resolve, 200));
  }
}

async function cameras(): Promise<void> {
  const created = await client.POST("/v1/cameras", {
    body: { id: camera, image_size: { width_px: 1280, height_px: 720 }, gnss_error: "unknown" },
  });
  expect(body(created).revision === 1, "a new camera has revision 1");
  const etag = created.response.headers.get("etag") ?? "";
  const changed = body(
    await client.PATCH("/v1/cameras/{camera}", {
      params: { path, header: { "if-match": etag } },
      body: { labels: { site: "north" }, gnss_error: { sigma_m: 3 } },
    }),
  );
  expect(changed.labels.site === "north", "the label is stored");
  const stale = await client.PATCH("/v1/cameras/{camera}", {
    params: { path, header: { "if-match": etag } },
    body: { display_name: "Square" },
  });
  expect(stale.error?.type === "urn:sightfix:problem:revision-mismatch", "a change of another revision is refused");
  const wrong = await client.POST("/v1/cameras", { body: { id: "yard", image_size: { width_px: 0, height_px: 1 } } });
  expect(wrong.error?.violations?.[0]?.field === "image_size.width_px", "the field at fault is named");
  const missing = await client.GET("/v1/cameras/{camera}", { params: { path: { camera: "yard" } } });
  expect(missing.response.status === 404, "an unknown camera is not found");
  body(await client.GET("/v1/cameras/{camera}", { params: { path } }));
  expect(body(await client.GET("/v1/cameras", { params: { query: { limit: 1 } } })).items.length === 1, "one camera");
  body(await client.GET("/v1/camera-statuses"));
  body(await client.GET("/v1/cameras/{camera}/learning", { params: { path } }));
}

async function samples(): Promise<void> {
  const csv = readFileSync(training as string, "utf8");
  const imported = body(
    await client.POST("/v1/cameras/{camera}/samples", {
      params: { path, query: { durability: "synced" } },
      headers: { "content-type": "text/csv" },
      body: csv,
      ...text,
    }),
  );
  expect(imported.accepted > 0 && imported.rejected === 0, "all rows are stored");
  const page = inJson(body(await client.GET("/v1/cameras/{camera}/samples", { params: { path, query: { limit: 2 } } })));
  expect(page.items.length === 2 && typeof page.next_cursor === "string", "a page has two samples");
  const again = await client.POST("/v1/cameras/{camera}/samples", { params: { path }, body: [...page.items] });
  expect(body(again).duplicate === 2, "stored samples are counted as duplicates");
  const counted = body(await client.GET("/v1/cameras/{camera}/samples/count", { params: { path } }));
  expect(counted.count === imported.accepted, "all rows are counted");
  const deleted = await client.DELETE("/v1/cameras/{camera}/samples", {
    params: { path, query: { target_id: "nobody" } },
  });
  expect(body(deleted).deleted === 0, "nothing is deleted");
  const form = new FormData();
  form.append("detections", new Blob(["time,target_id,left,top,width,height\n2026-01-01T12:00:00Z,a,1,2,3,4\n"]), "a.csv");
  form.append("fixes", new Blob(["time,target_id,longitude,latitude\n2026-01-01T12:00:00Z,a,24.7,59.4\n"]), "b.csv");
  body(
    await client.POST("/v1/cameras/{camera}/samples/pairings", {
      params: { path, query: { estimate_offset: true } },
      body: { detections: "", fixes: "" },
      bodySerializer: () => form,
    }),
  );
  body(await client.DELETE("/v1/cameras/{camera}/samples", { params: { path, query: { target_id: "a" } } }));
  const fixes = Array.from({ length: 12 }, (_, index) => ({
    longitude_deg: 24.7 + 1e-6 * (index % 3),
    latitude_deg: 59.4 + 1e-6 * (index % 2),
  }));
  body(await client.POST("/v1/cameras/{camera}/gnss-error", { params: { path }, body: { fixes } }));
}

async function models(): Promise<void> {
  const run = body(
    await client.POST("/v1/cameras/{camera}/training-runs", {
      params: { path },
      body: { recipe: "projective", epochs: 20 },
    }),
  );
  const runPath = { camera, run: run.id };
  const done = await ended(async () =>
    body(await client.GET("/v1/cameras/{camera}/training-runs/{run}", { params: { path: runPath } })),
  );
  const model = done.model_version ?? 0;
  expect(model === 1, "the run yields version 1");
  body(await client.GET("/v1/cameras/{camera}/training-runs/{run}/log", { params: { path: runPath } }));
  body(await client.GET("/v1/cameras/{camera}/training-runs/{run}/curve", { params: { path: runPath } }));
  body(await client.GET("/v1/cameras/{camera}/training-runs", { params: { path } }));
  const late = await client.POST("/v1/cameras/{camera}/training-runs/{run}/cancel", { params: { path: runPath } });
  expect(late.response.status === 409, "a run that has ended cannot be cancelled");
  const events = await client.GET("/v1/cameras/{camera}/training-runs/{run}/events", {
    params: { path: runPath },
    parseAs: "stream",
  });
  expect(events.response.ok, "the events of a run can be read");
  await events.response.body?.cancel();
  await client.DELETE("/v1/cameras/{camera}/training-runs/{run}", { params: { path: runPath } });
  body(await client.GET("/v1/cameras/{camera}/models", { params: { path } }));
  body(await client.GET("/v1/cameras/{camera}/models/{model}", { params: { path: { camera, model } } }));
  body(await client.GET("/v1/cameras/{camera}/active-model", { params: { path } }));
  const file = await client.GET("/v1/cameras/{camera}/models/{model}/file", {
    params: { path: { camera, model } },
    parseAs: "arrayBuffer",
  });
  const copied = await client.POST("/v1/cameras/{camera}/models", {
    params: { path },
    headers: { "content-type": "application/vnd.safetensors" },
    // The description says an array of numbers where it means bytes.
    body: file.data as never,
    bodySerializer: (bytes: unknown) => bytes as ArrayBuffer,
  });
  const copy = body(copied).number;
  body(await client.PUT("/v1/cameras/{camera}/active-model", { params: { path }, body: { number: copy } }));
  body(await client.POST("/v1/cameras/{camera}/active-model/roll-back", { params: { path } }));
  const removed = await client.DELETE("/v1/cameras/{camera}/models/{model}", {
    params: { path: { camera, model: copy } },
  });
  expect(removed.response.status === 204, "a version that is not active can be deleted");
}

async function fuse(request: components["schemas"]["FusionRequest"]): Promise<components["schemas"]["FusedFix"][]> {
  const answer = body(await client.POST("/v1/cameras/{camera}/fusions", { params: { path }, body: request }));
  return inJson(answer).items;
}

/** An answer that is GeoJSON where the client asks for it, and here is not. */
function inJson<Answer extends object>(answer: Answer): Extract<Answer, { items: unknown }> {
  if (!("items" in answer)) throw new Error("the answer has no items");
  return answer as Extract<Answer, { items: unknown }>;
}

async function positions(): Promise<void> {
  const page = inJson(body(await client.GET("/v1/cameras/{camera}/samples", { params: { path, query: { limit: 3 } } })));
  const observations: Observation[] = page.items.map(({ time, target_id, bounding_box }) => ({
    time,
    target_id,
    bounding_box,
  }));
  const [first] = observations;
  expect(first !== undefined, "there are samples");
  const [one] = await fuse(first as Observation);
  expect(one?.flags.includes("gnss_denied") === true, "a box alone has the flag gnss_denied");
  const all = await fuse({ observations });
  expect(all.length === observations.length, "every observation has a position");
  expect(all.every((it) => it.r95_m > 0), "every position has a radius");
  body(await client.POST("/v1/cameras/{camera}/tracks", { params: { path }, body: { observations } }));
  const tracks = body(await client.GET("/v1/cameras/{camera}/tracks", { params: { path } }));
  const target = tracks.features[0]?.properties.target_id ?? "";
  body(await client.GET("/v1/cameras/{camera}/tracks/{target}", { params: { path: { camera, target } } }));
  const events = await client.GET("/v1/cameras/{camera}/events", { params: { path }, parseAs: "stream" });
  await events.data?.cancel();
}

async function sites(): Promise<void> {
  const site = "harbour";
  const created = await client.POST("/v1/sites", { body: { id: site } });
  expect(body(created).revision === 1, "a new site has revision 1");
  const changed = await client.PATCH("/v1/sites/{site}", {
    params: { path: { site }, header: { "if-match": created.response.headers.get("etag") ?? "" } },
    body: { display_name: "Harbour" },
  });
  expect(body(changed).display_name === "Harbour", "the name is stored");
  body(await client.GET("/v1/sites"));
  body(await client.GET("/v1/sites/{site}", { params: { path: { site } } }));
  body(
    await client.PATCH("/v1/cameras/{camera}", { params: { path, header: { "if-match": "*" } }, body: { site } }),
  );
  body(await client.GET("/v1/sites/{site}/tracks", { params: { path: { site } } }));
  const events = await client.GET("/v1/sites/{site}/events", { params: { path: { site } }, parseAs: "stream" });
  await events.response.body?.cancel();
  const unknown = { site, track: "00000000-0000-7000-8000-000000000000" };
  const missing = await client.GET("/v1/sites/{site}/tracks/{track}", { params: { path: unknown } });
  expect(missing.response.status === 404, "an unknown track is not found");
  const used = await client.DELETE("/v1/sites/{site}", { params: { path: { site } } });
  expect(used.response.status === 409, "a site with cameras cannot be deleted");
  body(
    await client.PATCH("/v1/cameras/{camera}", {
      params: { path, header: { "if-match": "*" } },
      body: { site: null },
    }),
  );
  const deleted = await client.DELETE("/v1/sites/{site}", { params: { path: { site } } });
  expect(deleted.response.ok, "the site is deleted");
}

async function evaluations(): Promise<void> {
  const started = body(
    await client.POST("/v1/evaluations", { body: { camera_id: camera, seeds: 1, methods: ["gnss"] } }),
  );
  const evaluation = started.id;
  const done = await ended(async () =>
    body(await client.GET("/v1/evaluations/{evaluation}", { params: { path: { evaluation } } })),
  );
  expect((done.report?.methods.gnss?.n ?? 0) > 0, "the report has the method");
  body(await client.GET("/v1/evaluations", { params: { query: { camera } } }));
  await client.POST("/v1/evaluations/{evaluation}/cancel", { params: { path: { evaluation } } });
  await client.DELETE("/v1/evaluations/{evaluation}", { params: { path: { evaluation } } });
}

async function service(): Promise<void> {
  body(await client.GET("/v1/server"));
  body(await client.GET("/v1/session"));
  await client.GET("/livez", { parseAs: "text" });
  await client.GET("/readyz", { parseAs: "text" });
  await client.GET("/metrics", { parseAs: "text" });
  body(await client.GET("/v1/audit", { params: { query: { camera } } }));
}

/** The last one: once a key exists, every request needs one. */
async function keys(): Promise<void> {
  const created = body(await client.POST("/v1/keys", { body: { name: "Ada", role: "admin" } }));
  expect((await client.GET("/v1/cameras")).response.status === 401, "a request without a key is refused");
  const headers = { authorization: `Bearer ${created.secret}` };
  body(await client.GET("/v1/keys", { headers }));
  const key = { key: created.id };
  body(await client.GET("/v1/keys/{key}", { params: { path: key }, headers }));
  body(await client.POST("/v1/session", { body: { key: created.secret } }));
  await client.DELETE("/v1/session", { headers });
  const deleted = await client.DELETE("/v1/cameras/{camera}", { params: { path }, headers });
  expect(deleted.response.status === 204, "the camera is deleted");
  await client.DELETE("/v1/keys/{key}", { params: { path: key }, headers });
}

for (const part of [cameras, samples, models, positions, sites, evaluations, service, keys]) await part();

const operations = description.operations();
const unused = operations.filter((operation) => !description.seen.has(operation));
const others = unused.length > 0 ? `; not asked: ${unused.join(", ")}` : "";
console.log(`${description.seen.size} of ${operations.length} operations answered as described${others}`);
