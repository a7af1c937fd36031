// Order of search results: user pages, then results and others, then the Python reference. The numbers are Sphinx's own.
var Scorer = {
  score: ([page, , , , score]) => score - (page.startsWith("docs/api/") ? 2000 : /^(docs|notebooks)\//.test(page) ? 0 : 1000),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
