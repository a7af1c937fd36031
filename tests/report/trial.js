// What a reader does with a report, and what she sees of it; appended to a page by the tests.
const found = { errors: window.problems };
const text = (node) => node.textContent.trim();

function column(table, index) {
  const rows = [...table.tBodies[0].rows].filter((row) => !row.hidden);
  return rows.map((row) => text(row.cells[index]).replaceAll("\u00a0", " "));
}

function point(shape, x, y) {
  const box = shape.getBoundingClientRect();
  const place = { clientX: box.left + x * box.width, clientY: box.top + y * box.height };
  shape.dispatchEvent(new PointerEvent("pointermove", place));
  return text(shape.parentElement.querySelector(".value"));
}

function tryAll() {
  found.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const tables = [...document.querySelectorAll("section table")];
  const claims = tables.find((table) => text(table.tHead).includes("verdict"));
  const headings = [...claims.tHead.rows[0].cells].map((cell) => text(cell));
  const measured = headings.findIndex((name) => name === "measured" || name === "holds if") + (headings.length === 8 ? 1 : 0);
  const heading = claims.tHead.querySelectorAll("button")[measured];
  heading.click();
  found.rising = column(claims, measured);
  heading.click();
  found.falling = column(claims, measured);
  const filter = claims.closest("section").querySelector(".filter");
  const [words, verdict] = [filter.querySelector("input"), filter.querySelector("select")];
  verdict.value = "contradicted";
  verdict.dispatchEvent(new Event("change"));
  found.failed = column(claims, headings.length - 1);
  found.count = text(filter.querySelector("span"));
  verdict.value = "";
  words.value = "second pull";
  words.dispatchEvent(new Event("input"));
  found.words = column(claims, measured);
  document.querySelectorAll("details").forEach((details) => { details.open = true; });
  found.points = document.querySelectorAll(".chart svg circle").length;
  found.curve = point(document.querySelector(".chart svg"), 0.98, 0.5);
  found.map = point(document.querySelector(".chart canvas"), 0.98, 0.1);
  document.querySelector("figure img").click();
  found.dialog = document.querySelector("dialog").open;
}

try {
  tryAll();
} catch (error) {
  found.errors.push(String(error.stack));
}
const result = document.createElement("pre");
result.id = "found";
result.textContent = btoa(encodeURIComponent(JSON.stringify(found)));
document.body.append(result);
