// Search results: users' pages before theory, reference and maintainers' pages (html_search_scorer in conf.py).
var Scorer = {
  score: ([docname, , , , score]) => {
    if (/^(install|quick_start|ros$|notebooks\/index|how_to\/(?!index))/.test(docname)) return score + 20;
    if (/^(egm|conventions)$/.test(docname)) return score + 15;
    if (/^(concepts|cell|notebooks\/|gallery|from_robotlib)/.test(docname)) return score + 5;
    if (/^(decisions\/|benchmarks_all|changelog)/.test(docname)) return score - 5;
    return score;
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
