"""The extended parameter protocol of one component (PARAM_EXT_*): table, reads, writes, lists.

`change`: a change of one extended parameter.
`extended`: all of it together, as one machine of the component.
`fetch`: PARAM_EXT_REQUEST_LIST and the repair of its gaps.
`reads`: PARAM_EXT_REQUEST_READ.
`table`: the extended parameters.
`write_batch`: many PARAM_EXT_SETs in one call.
`writes`: PARAM_EXT_SET.
"""
