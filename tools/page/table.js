// Sorting of the tables by a click on a heading: rows within their scene and budget, for errors of two scenes do not
// compare. The tables of all metrics are sorted together, so that another metric keeps the order that was asked for.

function sortable() {
  const tables = [...document.querySelectorAll("table.results")].map((one) => ({
    heads: [...one.tHead.rows[0].cells],
    groups: [...one.tBodies].map((body) => ({body, rows: [...body.rows].slice(1)})),  // as they were
  }));
  let sorted = -1, order = "";

  // What a column says of a row: words in the first one, else a number or nothing.
  function valueOf(row, column) {
    const cell = row.cells[column], text = cell.dataset.value ?? cell.textContent;
    return column === 0 ? text : text === "" ? null : Number(text);
  }

  function compare(a, b) {
    if (a === null || b === null) return (a === null) - (b === null);  // what has no figure is last in both orders
    const difference = typeof a === "string" ? a.localeCompare(b) : a - b;
    return order === "ascending" ? difference : -difference;
  }

  function sortBy(column) {
    order = column !== sorted || order === "" ? "ascending" : order === "ascending" ? "descending" : "";
    sorted = column;
    for (const {heads, groups} of tables) {
      heads.forEach((head) => head.removeAttribute("aria-sort"));
      if (order) heads[column].setAttribute("aria-sort", order);
      for (const {body, rows} of groups) {
        const inOrder = [...rows];
        if (order) inOrder.sort((a, b) => compare(valueOf(a, column), valueOf(b, column)));
        body.append(...inOrder);
      }
    }
  }

  for (const {heads} of tables) {
    heads.forEach((head, column) => {
      if (head.classList.contains("interval")) return;  // it belongs to the column before
      const button = element("button", {}, ...head.childNodes);
      button.addEventListener("click", () => sortBy(column));
      head.append(button);
    });
  }
}
