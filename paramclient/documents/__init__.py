"""What is told as JSON: the command prints these documents, the service sends them.

Each is built by `of(…)` from what the library gives. `param` is one parameter; `component`, `link`, `job`,
`call` and `problem` are what the service tells of those; `setup` are plans and what became of them; `diff`,
`written`, `past`, `cached` and `fleet` what is compared and kept; `traffic` is a link; `command` what the
command tells of its own doing. They load pydantic: import one where JSON is made, and no other.
"""
