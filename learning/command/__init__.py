"""The verbs that train, evaluate, report, refine, correct, distill, convert, and open the page."""
