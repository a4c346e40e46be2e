/* Copy of equal messages to columns, in one pass over the messages and without Python's lock.
 *
 * The module is optional: if it was not built, NumPy does the same. All offsets are checked here,
 * because they come from files that may be damaged.
 */

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030b0000
#include <Python.h>
#include <stdint.h>
#include <string.h>

/* Number of messages whose fields are copied together, so that the messages stay in the cache. */
#define BLOCK 128
/* Fields of at most this many bytes are collected in a buffer. Writing a column in long pieces is
 * faster, because the processor then does not read the old contents of its memory. */
#define SHORT_BYTES 128
/* Longer fields are copied in pieces of this many bytes, each by a few instructions. */
#define PIECE 16
/* An index entry: log_time and offset of a message, two little-endian numbers. */
#define ENTRY_BYTES 16
/* Position of log_time in a Message record: after opcode, length, channel and sequence number. */
#define TIME_OFFSET 15

/* Bytes at an offset of each record: either expected bytes, or the rows of a column. */
typedef struct {
    Py_ssize_t offset, bytes;
    Py_buffer buffer;
} Part;

typedef struct {
    Part *parts;
    Py_ssize_t count;
} Parts;

/* Eight bytes at an offset of each record; those in the mask must have this value. */
typedef struct {
    Py_ssize_t offset;
    uint64_t value, mask;
} Word;

static uint64_t
word_at(const unsigned char *bytes)
{
    uint64_t word;
    memcpy(&word, bytes, sizeof word);
    return word;
}

static uint64_t
little_endian(const unsigned char *bytes)
{
    uint64_t value = 0;
    for (int k = 7; k >= 0; k--) {
        value = value << 8 | bytes[k];
    }
    return value;
}

static void
release(Parts *found)
{
    for (Py_ssize_t k = 0; k < found->count; k++) {
        PyBuffer_Release(&found->parts[k].buffer);
    }
    PyMem_Free(found->parts);
}

/* Read a list of pairs (offset, buffer). With PyBUF_ND in the flags, a buffer is a column of at
 * least `rows` items; otherwise, it is one item. An item at the offset must be within a record of
 * `size` bytes. Return 0 and set an exception if the list is invalid. */
static int
read_parts(PyObject *list, int flags, Py_ssize_t size, Py_ssize_t rows, Parts *found)
{
    Py_ssize_t count = PyList_Size(list);
    found->count = 0;
    found->parts = PyMem_Malloc((count ? count : 1) * sizeof(Part));
    if (found->parts == NULL) {
        PyErr_NoMemory();
        return 0;
    }
    for (Py_ssize_t k = 0; k < count; k++) {
        Part *part = &found->parts[k];
        PyObject *pair = PyList_GetItem(list, k), *object;
        if (!PyTuple_Check(pair)) {
            PyErr_SetString(PyExc_TypeError, "a part must be a tuple of an offset and a buffer");
            release(found);
            return 0;
        }
        if (!PyArg_ParseTuple(pair, "nO", &part->offset, &object) ||
            PyObject_GetBuffer(object, &part->buffer, flags) < 0) {
            release(found);
            return 0;
        }
        found->count++;
        Py_ssize_t items = !(flags & PyBUF_ND) ? 1 : part->buffer.ndim ? part->buffer.shape[0] : 0;
        if (items < rows) {
            PyErr_SetString(PyExc_ValueError, "a column has too few rows");
            release(found);
            return 0;
        }
        part->bytes = part->buffer.len / items;
        if (part->offset < 0 || part->offset > size || part->bytes > size - part->offset) {
            PyErr_SetString(PyExc_ValueError, "a field is not within the record");
            release(found);
            return 0;
        }
    }
    return 1;
}

/* Convert expected bytes to words, because comparing a word is faster than calling memcmp. The
 * words are within a record of `size` bytes. Return NULL and set an exception if memory is short. */
static Word *
words_of(const Parts *expected, Py_ssize_t size, Py_ssize_t *count)
{
    Py_ssize_t most = 1;
    for (Py_ssize_t k = 0; k < expected->count; k++) {
        most += (expected->parts[k].buffer.len + 7) / 8;
    }
    Word *words = PyMem_Malloc(most * sizeof(Word));
    *count = 0;
    if (words == NULL) {
        PyErr_NoMemory();
        return NULL;
    }
    for (Py_ssize_t k = 0; k < expected->count; k++) {
        const Part *part = &expected->parts[k];
        for (Py_ssize_t done = 0; done < part->buffer.len; done += 8) {
            Py_ssize_t bytes = part->buffer.len - done < 8 ? part->buffer.len - done : 8;
            Py_ssize_t offset = part->offset + done, start = offset <= size - 8 ? offset : size - 8;
            unsigned char value[8] = {0}, mask[8] = {0};
            memcpy(value + (offset - start), (unsigned char *)part->buffer.buf + done, bytes);
            memset(mask + (offset - start), 0xff, bytes);
            words[(*count)++] = (Word){start, word_at(value), word_at(mask)};
        }
    }
    return words;
}

/* With a constant size, the compiler replaces each call of memcpy by a few instructions. */
#define COPY_EACH(SIZE)                                      \
    for (Py_ssize_t k = 0; k < count; k++) {                 \
        memcpy(target + k * (SIZE), rows[k] + offset, SIZE); \
    }

static void
copy_field(unsigned char *target, const unsigned char *const *rows, Py_ssize_t count,
           Py_ssize_t offset, Py_ssize_t size)
{
    switch (size) {
    case 1:
        COPY_EACH(1)
        break;
    case 4:
        COPY_EACH(4)
        break;
    case 8:
        COPY_EACH(8)
        break;
    default:
        if (size < PIECE) {
            COPY_EACH(size)
            break;
        }
        for (Py_ssize_t k = 0; k < count; k++) {
            const unsigned char *source = rows[k] + offset;
            Py_ssize_t done = 0;
            for (; done <= size - PIECE; done += PIECE) {
                memcpy(target + k * size + done, source + done, PIECE);
            }
            /* The last piece overlaps the piece before it. */
            memcpy(target + (k + 1) * size - PIECE, source + size - PIECE, PIECE);
        }
    }
}

/* Copy the fields of all messages, and return whether all of them have the expected bytes and the
 * times of their index entries. Stop before the first block with a message that does not. */
static int
copy_rows(const Py_buffer *records, const Py_buffer *index, Py_ssize_t size, const Word *words,
          Py_ssize_t word_count, const Parts *columns, Py_ssize_t row)
{
    const unsigned char *rows[BLOCK], *entry = index->buf;
    unsigned char collected[BLOCK * SHORT_BYTES];
    Py_ssize_t total = index->len / ENTRY_BYTES;
    for (Py_ssize_t first = 0; first < total; first += BLOCK) {
        Py_ssize_t count = total - first < BLOCK ? total - first : BLOCK;
        for (Py_ssize_t k = 0; k < count; k++, entry += ENTRY_BYTES) {
            uint64_t offset = little_endian(entry + 8);
            if (offset > (uint64_t)(records->len - size)) {
                return 0;
            }
            rows[k] = (const unsigned char *)records->buf + offset;
            uint64_t differs = word_at(rows[k] + TIME_OFFSET) ^ word_at(entry);
            for (Py_ssize_t n = 0; n < word_count; n++) {
                uint64_t found = word_at(rows[k] + words[n].offset);
                differs |= (found ^ words[n].value) & words[n].mask;
            }
            if (differs) {
                return 0;
            }
        }
        for (Py_ssize_t n = 0; n < columns->count; n++) {
            const Part *part = &columns->parts[n];
            unsigned char *target = (unsigned char *)part->buffer.buf + (row + first) * part->bytes;
            if (part->bytes > SHORT_BYTES) {
                copy_field(target, rows, count, part->offset, part->bytes);
            }
            else {
                copy_field(collected, rows, count, part->offset, part->bytes);
                memcpy(target, collected, count * part->bytes);
            }
        }
    }
    return 1;
}

PyDoc_STRVAR(copy_fields_doc,
             "copy_fields(records, index, size, expected, targets, row)\n--\n\n"
             "Copy fields of messages to columns; return whether all messages are as expected.\n\n"
             "If not, the contents of the columns are undefined.\n\n"
             "Args:\n"
             "    records: Bytes that contain the messages.\n"
             "    index: Contiguous array of `INDEX_ENTRY`, at least one.\n"
             "    size: Number of bytes of each message's record.\n"
             "    expected: List of offsets in the record, with the bytes that must be there.\n"
             "    targets: List of offsets in the record, with the column for the field there: a\n"
             "        contiguous array.\n"
             "    row: Row of the columns for the first message; the next rows are for the others.\n\n"
             "Raises:\n"
             "    ValueError: The index is empty, a field is not within the record, or a column has\n"
             "        too few rows.");

static PyObject *
copy_fields(PyObject *module, PyObject *args)
{
    Py_buffer records, index;
    Py_ssize_t size, row;
    PyObject *constants, *targets, *found = NULL;
    Parts expected, columns;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*nO!O!n", &records, &index, &size, &PyList_Type, &constants,
                          &PyList_Type, &targets, &row)) {
        return NULL;
    }
    Py_ssize_t total = index.len / ENTRY_BYTES;
    if (!total || size < TIME_OFFSET + 8 || row < 0 || row > PY_SSIZE_T_MAX - total) {
        PyErr_SetString(PyExc_ValueError,
                        "there are no messages, the record is too short, or the row is not valid");
    }
    else if (read_parts(constants, PyBUF_SIMPLE, size, 1, &expected)) {
        Py_ssize_t word_count;
        Word *words = words_of(&expected, size, &word_count);
        if (words != NULL &&
            read_parts(targets, PyBUF_WRITABLE | PyBUF_ND, size, row + total, &columns)) {
            int are_expected = 0;
            Py_BEGIN_ALLOW_THREADS
            if (records.len >= size) {
                are_expected = copy_rows(&records, &index, size, words, word_count, &columns, row);
            }
            Py_END_ALLOW_THREADS
            found = PyBool_FromLong(are_expected);
            release(&columns);
        }
        PyMem_Free(words);
        release(&expected);
    }
    PyBuffer_Release(&records);
    PyBuffer_Release(&index);
    return found;
}

static PyMethodDef methods[] = {
    {"copy_fields", copy_fields, METH_VARARGS, copy_fields_doc},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_native", "Compiled copy of messages to columns.", 0, methods,
    NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC
PyInit__native(void)
{
    return PyModule_Create(&definition);
}
