"""The operator's page: the camera's picture, the plan, and what is asked, in a browser.

It takes the place of the operator's terminal and of nothing else: what moves the arm is told the
same answers, and knows of no page. A question is answered by a click that saw it. Whatever does not
arrive, arrives late or belongs to an earlier question is no answer, and the arm stays where it is.
"""
