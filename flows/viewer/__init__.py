"""`cat3d view`: a scene in the browser.

`content` reads what there is to see, `preview` makes the splats that are shown while the camera moves, `ladder` renders
what it rests on, `session` is what one browser sees, `server` serves all of them.
"""
