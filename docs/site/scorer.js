// The order of the search: the page of other programs' words, pages for users, long lists, and last what is for developers.
const LAST = /^explanation\/(decisions|accuracy|performance|cluster|years|reliability|live_speed|page_speed|install_size|architecture|tested)|^reference\/(api|errors)/;
const LISTS = /^reference\/(command_line|camera_drivers|settings|rig_file)|^tutorial\/(bluesky|closed_loop)/;
const weight = (doc) => (LAST.test(doc) ? -100 : LISTS.test(doc) ? -20 : doc === "tutorial/other_programs" ? 12 : doc === "reference/gauges" ? 6 : 0);
var Scorer = {
  score: (result) => result[4] + weight(result[0]),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
