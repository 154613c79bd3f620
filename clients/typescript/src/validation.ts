// Checks that every response is what the OpenAPI description says of its operation.

import { readFileSync } from "node:fs";
import { Ajv2020, type ValidateFunction } from "ajv/dist/2020.js";
import formats from "ajv-formats";
import type { Middleware } from "openapi-fetch";

type Json = { [key: string]: unknown };
type Operation = { operationId: string; responses: { [status: string]: { content?: Json } } };

const PREFIX = "#/components/schemas/";

/** The operations of a description, and checks of their responses. */
export class Description {
  readonly seen = new Set<string>();
  private readonly document: { paths: { [path: string]: { [method: string]: Operation } }; components: Json };
  private readonly ajv: Ajv2020;
  private readonly validators = new Map<string, ValidateFunction>();

  constructor(file: string) {
    this.document = JSON.parse(readFileSync(file, "utf8"));
    forbidUndescribedProperties(this.document.components);
    this.ajv = new Ajv2020({ strict: false, allErrors: true });
    formats.default(this.ajv);
    for (const format of ["int32", "int64", "double", "uint32"]) this.ajv.addFormat(format, true);
    this.ajv.addSchema({ $id: "description", components: this.document.components });
  }

  /** Names of all operations. */
  operations(): string[] {
    return Object.values(this.document.paths).flatMap((path) => Object.values(path).map((it) => it.operationId));
  }

  /** Throws if a response has a status, a media type or a body that the description does not name. */
  async check(method: string, path: string, response: Response): Promise<void> {
    const operation = this.document.paths[path]?.[method.toLowerCase()];
    if (operation === undefined) throw new Error(`${method} ${path} is not described`);
    const name = `${operation.operationId} ${response.status}`;
    const described = operation.responses[String(response.status)];
    if (described === undefined) throw new Error(`${name}: the status is not described`);
    this.seen.add(operation.operationId);
    const mediaType = response.headers.get("content-type")?.split(";")[0];
    if (described.content === undefined) {
      if (mediaType !== undefined) throw new Error(`${name}: a body of ${mediaType} is not described`);
      return;
    }
    if (mediaType === undefined || !(mediaType in described.content)) {
      throw new Error(`${name}: ${mediaType} is not described, but ${Object.keys(described.content).join(", ")}`);
    }
    if (!mediaType.endsWith("json")) return;
    const validate = this.validator(name, (described.content[mediaType] as { schema: Json }).schema);
    if (!validate(await response.clone().json())) {
      throw new Error(`${name}: ${this.ajv.errorsText(validate.errors, { separator: "\n  " })}`);
    }
  }

  /** Checks all responses of a client. */
  middleware(): Middleware {
    return {
      onResponse: async ({ request, schemaPath, response }) => {
        await this.check(request.method, schemaPath, response);
      },
    };
  }

  private validator(name: string, schema: Json): ValidateFunction {
    const known = this.validators.get(name);
    if (known !== undefined) return known;
    const text = JSON.stringify(schema).replaceAll(`"${PREFIX}`, `"description${PREFIX}`);
    const compiled = this.ajv.compile(JSON.parse(text));
    this.validators.set(name, compiled);
    return compiled;
  }
}

/** A property that the description does not name is an error; schemas that others extend cannot say so. */
function forbidUndescribedProperties(components: Json): void {
  const extended = new Set<unknown>();
  const visit = (node: unknown, inExtension: boolean): void => {
    if (Array.isArray(node)) {
      for (const element of node) visit(element, inExtension);
    } else if (typeof node === "object" && node !== null) {
      const object = node as Json;
      if (typeof object.$ref === "string" && inExtension) extended.add(object.$ref.slice(PREFIX.length));
      for (const [key, value] of Object.entries(object)) visit(value, key === "allOf");
    }
  };
  const schemas = components.schemas as { [name: string]: Json };
  visit(schemas, false);
  for (const [name, schema] of Object.entries(schemas)) {
    if (!extended.has(name) && ("properties" in schema || "allOf" in schema)) schema.unevaluatedProperties = false;
  }
}
