// FOR_EACH(i, count) { body }: every i below count once, whatever the launch; `continue` skips one.
// Item form: a few work-items, one or two a core, walk contiguous runs (a vectoriser that spreads
// rows of 45 floats over lanes only makes gathers of them). Group form: a work-item an element.
#if FORM_ITEM
#define FOR_EACH(i, count)                                                                         \
    for (ulong i = (ulong)(count) * get_global_id(0) / get_global_size(0),                         \
               i##_end = (ulong)(count) * (get_global_id(0) + 1) / get_global_size(0);             \
         i < i##_end; i++)
#else
#define FOR_EACH(i, count)                                                                         \
    for (ulong i = get_global_id(0); i < (count); i += get_global_size(0))
#endif
