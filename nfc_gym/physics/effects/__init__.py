"""The effects that a model may lack: one interface (`Effect`), one family a file, and the library that lists them."""
