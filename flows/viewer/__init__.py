"""`cat3d view`: a scene in the browser.

`run` is what someone looks at, as far as it has come, `ladder` renders what the camera rests on, `session` is what one
browser sees, `server` serves all of them.
"""
