# Writes to OUT which commit the checkout SOURCE is at, -dirty where its files have changed since; nothing where SOURCE is
# no checkout or git does not say. A repository further up would be somebody else's.
#   cmake -D SOURCE=. -D OUT=commit.txt -P commit.cmake
set(COMMIT "")
if(EXISTS ${SOURCE}/.git)
  execute_process(COMMAND git -C ${SOURCE} describe --always --dirty --abbrev=40 --exclude=*
    OUTPUT_VARIABLE COMMIT OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET)
endif()
file(WRITE ${OUT} "${COMMIT}")
