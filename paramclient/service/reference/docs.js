// The API reference, rendered from the OpenAPI document. Texts are inserted only as text.

const REF = "#/components/schemas/";

function make(name, text, ...children) {
  const element = document.createElement(name);
  if (text) element.textContent = text;
  element.append(...children);
  return element;
}

// Formats a schema like JSON: an object with the type of each member after its name.
function written(schema, schemas, depth, seen) {
  const inner = "  ".repeat(depth + 1);
  const outer = "  ".repeat(depth);
  if (schema.$ref) {
    const name = schema.$ref.slice(REF.length);
    if (seen.includes(name) || depth > 4) return name;
    return written(schemas[name], schemas, depth, [...seen, name]);
  }
  if (schema.anyOf) return [...new Set(schema.anyOf.map((each) => written(each, schemas, depth, seen)))].join(" | ");
  if (schema.enum) return schema.enum.map((each) => JSON.stringify(each)).join(" | ");
  if ("const" in schema) return JSON.stringify(schema.const);
  if (schema.type === "array") return `[${written(schema.items ?? {}, schemas, depth, seen)}, …]`;
  if (schema.properties) {
    const required = schema.required ?? [];
    const lines = Object.entries(schema.properties).map(([name, each]) => {
      const mark = required.includes(name) ? "" : "?";
      const given = each.default === undefined ? "" : ` = ${JSON.stringify(each.default)}`;
      return `${inner}${name}${mark}: ${written(each, schemas, depth + 1, seen)}${given}`;
    });
    return `{\n${lines.join("\n")}\n${outer}}`;
  }
  if (typeof schema.additionalProperties === "object") {
    return `{ NAME: ${written(schema.additionalProperties, schemas, depth, seen)}, … }`;
  }
  return schema.type ?? "anything";
}

function parametersOf(operation) {
  const table = make("table");
  for (const each of operation.parameters ?? []) {
    const kind = written(each.schema ?? {}, {}, 0, []);
    const row = make("tr", "");
    row.append(make("th", "", make("code", each.name)), make("td", `${each.in}${each.required ? "" : ", optional"}`));
    row.append(make("td", kind), make("td", each.description ?? ""));
    table.append(row);
  }
  return table;
}

function contentOf(title, content, schemas) {
  const parts = [];
  for (const [type, each] of Object.entries(content ?? {})) {
    parts.push(make("h3", `${title}: ${type}`));
    if (each.schema && Object.keys(each.schema).length) {
      parts.push(make("pre", written(each.schema, schemas, 0, [])));
    }
  }
  return parts;
}

function shown(method, path, operation, schemas) {
  const summary = make("summary", "", make("span", method.toUpperCase()), make("code", path));
  summary.firstChild.className = "method";
  const why = make("span", operation.description?.split("\n")[0] ?? "");
  why.className = "why";
  summary.append(why);
  const body = make("div", "");
  for (const paragraph of (operation.description ?? "").split("\n\n").slice(1)) body.append(make("p", paragraph));
  if (operation.parameters?.length) body.append(make("h3", "Parameters"), parametersOf(operation));
  body.append(...contentOf("Body", operation.requestBody?.content, schemas));
  for (const [status, answer] of Object.entries(operation.responses)) {
    const title = status === "default" ? "Otherwise" : `Answer ${status}`;
    const parts = contentOf(title, answer.content, schemas);
    body.append(...(parts.length ? parts : [make("h3", title)]));
  }
  const details = make("details", "", summary, body);
  details.dataset.words = `${method} ${path} ${operation.description ?? ""}`.toLowerCase();
  return details;
}

function show(api) {
  document.getElementById("summary").textContent = `${api.info.summary}. Version ${api.info.version}.`;
  const groups = new Map();
  for (const [path, methods] of Object.entries(api.paths)) {
    for (const [method, operation] of Object.entries(methods)) {
      const tag = operation.tags?.[0] ?? "others";
      if (!groups.has(tag)) groups.set(tag, make("section", "", make("h2", tag)));
      groups.get(tag).append(shown(method, path, operation, api.components.schemas));
    }
  }
  document.getElementById("operations").replaceChildren(...groups.values());
}

function search(event) {
  const words = event.target.value.toLowerCase().split(/\s+/).filter(Boolean);
  for (const each of document.querySelectorAll("details")) {
    each.hidden = !words.every((word) => each.dataset.words.includes(word));
  }
  for (const section of document.querySelectorAll("section")) {
    section.hidden = !section.querySelector("details:not([hidden])");
  }
}

document.getElementById("search").addEventListener("input", search);
try {
  const answer = await fetch("/openapi.json");
  if (!answer.ok) throw new Error(`the service answers ${answer.status}`);
  show(await answer.json());
} catch (error) {
  document.getElementById("operations").replaceChildren(make("p", `The document cannot be loaded: ${error.message}`));
}
