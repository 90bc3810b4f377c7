/* A V4L2 camera without a kernel driver: preloaded (LD_PRELOAD), it answers for one device path, so that the real ioctl
 * path of a program can be tested where there is no camera. Everything else passes through to the C library.
 *
 * V4L2_STAND_IN_DEVICE   the path that is answered for, for example /dev/video99
 * V4L2_STAND_IN_SCRIPT   a file of lines `key value`, read again for every frame and every open:
 *
 *   plugged 1      0: the device vanishes: open says ENOENT, ioctls ENODEV, poll reports a hang-up
 *   silent 0       1: exposes no frames, as a camera that hangs
 *   stuck 0        1: poll reports a hang-up for ever, DQBUF has nothing
 *   busy 0         1: somebody else streams: EBUSY
 *   open_errno 0   what open fails with
 *   driver NAME    of QUERYCAP
 *   formats LIST   offered, of GREY,YUYV,UYVY,NV12,MJPG,JPEG,H264 and others that are not filled
 *   width, height  the only size there is; 0: any
 *   fps 30
 *   lead_us 12000  from the stamp (start of exposure) to delivery
 *   controls 1     0: refuses exposure and gain
 *   stamp soe      soe: start of exposure, eof: end of frame, unknown: not monotonic
 *   damaged 0      1: buffers carry the error flag
 *   jpeg FILE      the image of MJPG and JPEG
 *   planes 1       2: captures multi-planar only
 *   bandwidth 0    of the USB bus, pixels of raw images: larger ones do not start, ENOSPC; 0: any
 *
 * Frames of GREY, YUYV, UYVY and NV12 are uniform with luma 4 * sequence modulo 256. The sequence counts exposures: one for which no
 * buffer was queued is missing from it. As in the kernel, a filled buffer waits until it is taken.
 *
 * The file descriptor is the reading end of a pipe that holds a byte for each filled buffer, so poll and epoll work.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#define MAX_BUFFERS 16
#define MAX_OPEN 8
#define PAGE 4096
#define JPEG_ROOM (1 << 20)

/* The C library's function of a name that we define too. */
#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

struct script {
    int plugged, silent, stuck, busy, open_errno, width, height, lead_us, damaged, controls, planes, bandwidth;
    double fps;
    char driver[16], formats[64], stamp[16], jpeg[512];
};

struct filled {
    int index;
    uint32_t sequence, bytes;
    int64_t stamp_ns;
};

struct device { /* one open file */
    int fd, write_fd, memory_fd;
    int unplugged, streaming;
    struct v4l2_pix_format pix;
    uint8_t *memory;
    size_t buffer_size;
    int buffers;
    int queue[MAX_BUFFERS], queued;
    struct filled done[MAX_BUFFERS];
    int done_count;
    uint32_t sequence;
    pthread_t thread;
};

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static struct device *devices[MAX_OPEN];

static const char *device_path(void) { return getenv("V4L2_STAND_IN_DEVICE"); }
static int is_ours(const char *path) { return path && device_path() && !strcmp(path, device_path()); }

static struct device *find(int fd) {
    for (int i = 0; i < MAX_OPEN; i++)
        if (devices[i] && fd >= 0 && devices[i]->fd == fd) return devices[i];
    return NULL;
}

static struct script read_script(void) {
    struct script s = {.plugged = 1, .lead_us = 12000, .controls = 1, .fps = 30, .driver = "stand-in", .formats = "YUYV", .stamp = "soe"};
    const char *path = getenv("V4L2_STAND_IN_SCRIPT");
    FILE *file = path ? fopen(path, "r") : NULL;
    char line[600], key[32], value[512];
    while (file && fgets(line, sizeof line, file)) {
        if (sscanf(line, "%31s %511s", key, value) != 2) continue;
        if (!strcmp(key, "plugged")) s.plugged = atoi(value);
        else if (!strcmp(key, "silent")) s.silent = atoi(value);
        else if (!strcmp(key, "stuck")) s.stuck = atoi(value);
        else if (!strcmp(key, "busy")) s.busy = atoi(value);
        else if (!strcmp(key, "open_errno")) s.open_errno = atoi(value);
        else if (!strcmp(key, "width")) s.width = atoi(value);
        else if (!strcmp(key, "height")) s.height = atoi(value);
        else if (!strcmp(key, "lead_us")) s.lead_us = atoi(value);
        else if (!strcmp(key, "damaged")) s.damaged = atoi(value);
        else if (!strcmp(key, "planes")) s.planes = atoi(value);
        else if (!strcmp(key, "bandwidth")) s.bandwidth = atoi(value);
        else if (!strcmp(key, "controls")) s.controls = atoi(value);
        else if (!strcmp(key, "fps")) s.fps = atof(value);
        else if (!strcmp(key, "driver")) snprintf(s.driver, sizeof s.driver, "%.15s", value);
        else if (!strcmp(key, "formats")) snprintf(s.formats, sizeof s.formats, "%.63s", value);
        else if (!strcmp(key, "stamp")) snprintf(s.stamp, sizeof s.stamp, "%.15s", value);
        else if (!strcmp(key, "jpeg")) snprintf(s.jpeg, sizeof s.jpeg, "%s", value);
    }
    if (file) fclose(file);
    return s;
}

/* The frames ---------------------------------------------------------------------------------------------------- */

static uint32_t expose(struct device *d, uint8_t *image, const struct script *s) {
    uint8_t luma = 4 * d->sequence;
    if (d->pix.pixelformat == V4L2_PIX_FMT_MJPEG || d->pix.pixelformat == V4L2_PIX_FMT_JPEG) {
        FILE *file = fopen(s->jpeg, "r");
        uint32_t bytes = file ? fread(image, 1, d->pix.sizeimage, file) : 0;
        if (file) fclose(file);
        return bytes;
    }
    memset(image, 128, d->pix.sizeimage);
    uint32_t format = d->pix.pixelformat;
    size_t step = format == V4L2_PIX_FMT_YUYV || format == V4L2_PIX_FMT_UYVY ? 2 : 1;
    size_t end = format == V4L2_PIX_FMT_NV12 ? (size_t)d->pix.bytesperline * d->pix.height : d->pix.sizeimage;
    for (size_t at = format == V4L2_PIX_FMT_UYVY; at < end; at += step) image[at] = luma;
    return d->pix.sizeimage;
}

static void hang_up(struct device *d) {
    if (d->write_fd >= 0) NEXT(close)(d->write_fd); /* poll reports a hang-up for ever */
    d->write_fd = -1;
}

static void unplug(struct device *d) {
    d->unplugged = 1;
    hang_up(d);
}

static void *run(void *argument) {
    struct device *d = argument;
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    int64_t ns = (int64_t)at.tv_sec * 1000000000 + at.tv_nsec;
    for (;;) {
        struct script s = read_script();
        ns += (int64_t)(1e9 / s.fps);
        at.tv_sec = ns / 1000000000;
        at.tv_nsec = ns % 1000000000;
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
        pthread_mutex_lock(&lock);
        if (!s.plugged && !d->unplugged) unplug(d);
        if (s.stuck) hang_up(d);
        if (!d->streaming || d->write_fd < 0) {
            pthread_mutex_unlock(&lock);
            return NULL;
        }
        if (!s.silent) {
            if (d->queued > 0) {
                int index = d->queue[0];
                memmove(d->queue, d->queue + 1, sizeof(int) * --d->queued);
                struct filled f = {.index = index, .sequence = d->sequence, .stamp_ns = ns - 1000LL * s.lead_us};
                f.bytes = expose(d, d->memory + index * d->buffer_size, &s);
                d->done[d->done_count++] = f;
                if (write(d->write_fd, "", 1) != 1) abort();
            }
            d->sequence++;
        }
        pthread_mutex_unlock(&lock);
    }
}

/* The requests -------------------------------------------------------------------------------------------------- */

static uint32_t offered(const struct script *s, int index) {
    if ((size_t)index * 5 + 4 > strlen(s->formats)) return 0;
    const char *name = s->formats + index * 5;
    return v4l2_fourcc(name[0], name[1], name[2], name[3]);
}

static void negotiate(struct device *d, const struct v4l2_pix_format *asked, const struct script *s) {
    struct v4l2_pix_format *pix = &d->pix;
    uint32_t format = offered(s, 0);
    for (int i = 0; offered(s, i); i++)
        if (offered(s, i) == asked->pixelformat) format = asked->pixelformat;
    memset(pix, 0, sizeof *pix);
    pix->width = s->width ? (uint32_t)s->width : asked->width;
    pix->height = s->height ? (uint32_t)s->height : asked->height;
    pix->pixelformat = format;
    pix->field = V4L2_FIELD_NONE;
    pix->colorspace = V4L2_COLORSPACE_SRGB;
    /* Lines are padded as real drivers pad them. */
    if (format == V4L2_PIX_FMT_YUYV || format == V4L2_PIX_FMT_UYVY) pix->bytesperline = (pix->width * 2 + 63) / 64 * 64;
    if (format == V4L2_PIX_FMT_GREY || format == V4L2_PIX_FMT_NV12) pix->bytesperline = (pix->width + 63) / 64 * 64;
    pix->sizeimage = pix->bytesperline ? pix->bytesperline * pix->height : JPEG_ROOM;
    if (format == V4L2_PIX_FMT_NV12) pix->sizeimage = pix->sizeimage * 3 / 2;
}

static int stop_streaming(struct device *d) {
    int was = d->streaming;
    d->streaming = 0;
    if (was) {
        pthread_mutex_unlock(&lock);
        pthread_join(d->thread, NULL);
        pthread_mutex_lock(&lock);
    }
    char byte;
    while (d->done_count > 0 && d->done_count--)
        if (!d->unplugged && read(d->fd, &byte, 1) != 1) abort();
    d->queued = 0;
    return 0;
}

static int request_buffers(struct device *d, struct v4l2_requestbuffers *r) {
    if (r->memory != V4L2_MEMORY_MMAP) return EINVAL;
    if (r->count > MAX_BUFFERS) r->count = MAX_BUFFERS;
    r->capabilities = V4L2_BUF_CAP_SUPPORTS_MMAP;
    d->buffers = r->count;
    d->buffer_size = (d->pix.sizeimage + PAGE - 1) / PAGE * PAGE;
    size_t size = d->buffer_size * d->buffers;
    if (ftruncate(d->memory_fd, size)) return ENOMEM;
    d->memory = size ? NEXT(mmap)(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, d->memory_fd, 0) : NULL;
    return 0;
}

static int dequeue(struct device *d, struct v4l2_buffer *b, const struct script *s) {
    char byte;
    if (d->done_count == 0 || read(d->fd, &byte, 1) != 1) return EAGAIN;
    struct filled f = d->done[0];
    memmove(d->done, d->done + 1, sizeof f * --d->done_count);
    b->index = f.index;
    b->bytesused = f.bytes;
    b->length = d->buffer_size;
    b->sequence = f.sequence;
    b->field = V4L2_FIELD_NONE;
    b->timestamp.tv_sec = f.stamp_ns / 1000000000;
    b->timestamp.tv_usec = f.stamp_ns % 1000000000 / 1000;
    b->flags = V4L2_BUF_FLAG_MAPPED | V4L2_BUF_FLAG_DONE;
    if (strcmp(s->stamp, "unknown")) b->flags |= V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
    if (!strcmp(s->stamp, "soe")) b->flags |= V4L2_BUF_FLAG_TSTAMP_SRC_SOE;
    if (s->damaged) b->flags |= V4L2_BUF_FLAG_ERROR;
    return 0;
}

/* 0, or what errno is to be. */
static int answer(struct device *d, uint32_t request, void *argument) {
    struct script s = read_script();
    if (!s.plugged && !d->unplugged) unplug(d);
    if (d->unplugged && request != (uint32_t)VIDIOC_STREAMOFF) return ENODEV;
    switch (request) {
    case (uint32_t)VIDIOC_QUERYCAP: {
        struct v4l2_capability *c = argument;
        memset(c, 0, sizeof *c);
        strcpy((char *)c->driver, s.driver);
        strcpy((char *)c->card, "Stand-in camera");
        c->device_caps = (s.planes > 1 ? V4L2_CAP_VIDEO_CAPTURE_MPLANE : V4L2_CAP_VIDEO_CAPTURE) | V4L2_CAP_STREAMING;
        c->capabilities = c->device_caps | V4L2_CAP_DEVICE_CAPS;
        return 0;
    }
    case (uint32_t)VIDIOC_ENUM_FMT: {
        struct v4l2_fmtdesc *f = argument;
        if (!offered(&s, f->index)) return EINVAL;
        f->pixelformat = offered(&s, f->index);
        return 0;
    }
    case (uint32_t)VIDIOC_G_FMT: ((struct v4l2_format *)argument)->fmt.pix = d->pix; return 0;
    case (uint32_t)VIDIOC_S_FMT: {
        struct v4l2_format *f = argument;
        if (s.busy) return EBUSY;
        negotiate(d, &f->fmt.pix, &s);
        f->fmt.pix = d->pix;
        return 0;
    }
    case (uint32_t)VIDIOC_G_PARM:
    case (uint32_t)VIDIOC_S_PARM: {
        struct v4l2_captureparm *p = &((struct v4l2_streamparm *)argument)->parm.capture;
        p->capability = V4L2_CAP_TIMEPERFRAME;
        p->timeperframe.numerator = 1000;
        p->timeperframe.denominator = (uint32_t)(1000 * s.fps);
        return 0;
    }
    case (uint32_t)VIDIOC_S_CTRL: return s.controls ? 0 : EINVAL;
    case (uint32_t)VIDIOC_REQBUFS: return request_buffers(d, argument);
    case (uint32_t)VIDIOC_QUERYBUF: {
        struct v4l2_buffer *b = argument;
        if ((int)b->index >= d->buffers) return EINVAL;
        b->length = d->buffer_size;
        b->m.offset = b->index * d->buffer_size;
        return 0;
    }
    case (uint32_t)VIDIOC_QBUF: {
        struct v4l2_buffer *b = argument;
        if ((int)b->index >= d->buffers) return EINVAL;
        /* A buffer given back twice, or while the driver has it, is a bug of the program. */
        for (int i = 0; i < d->queued; i++)
            if (d->queue[i] == (int)b->index) return EINVAL;
        d->queue[d->queued++] = b->index;
        return 0;
    }
    case (uint32_t)VIDIOC_DQBUF: return dequeue(d, argument, &s);
    case (uint32_t)VIDIOC_STREAMON:
        if (s.bandwidth && d->pix.pixelformat != V4L2_PIX_FMT_MJPEG && d->pix.width * d->pix.height > (uint32_t)s.bandwidth)
            return ENOSPC;
        d->streaming = 1;
        return pthread_create(&d->thread, NULL, run, d);
    case (uint32_t)VIDIOC_STREAMOFF: return stop_streaming(d);
    }
    return ENOTTY;
}

/* The C library's doors ------------------------------------------------------------------------------------------ */

static int open_device(void) {
    struct script s = read_script();
    int ends[2];
    if (!s.plugged || s.open_errno) {
        errno = s.plugged ? s.open_errno : ENOENT;
        return -1;
    }
    struct device *d = calloc(1, sizeof *d);
    if (!d || pipe2(ends, O_CLOEXEC | O_NONBLOCK)) return -1;
    d->fd = ends[0];
    d->write_fd = ends[1];
    d->memory_fd = memfd_create("frames", MFD_CLOEXEC);
    struct v4l2_pix_format asked = {.width = 640, .height = 480};
    negotiate(d, &asked, &s);
    pthread_mutex_lock(&lock);
    int slot = 0;
    while (slot < MAX_OPEN && devices[slot]) slot++;
    if (slot == MAX_OPEN) abort(); /* the program under test leaks */
    devices[slot] = d;
    pthread_mutex_unlock(&lock);
    return d->fd;
}

#define OPEN(name)                                             \
    int name(const char *path, int flags, ...) {               \
        mode_t mode = 0;                                       \
        if (flags & (O_CREAT | O_TMPFILE)) {                   \
            va_list list;                                      \
            va_start(list, flags);                             \
            mode = va_arg(list, mode_t);                       \
            va_end(list);                                      \
        }                                                      \
        return is_ours(path) ? open_device() : NEXT(name)(path, flags, mode); \
    }
OPEN(open)
OPEN(open64)

int ioctl(int fd, unsigned long request, ...) {
    va_list list;
    va_start(list, request);
    void *argument = va_arg(list, void *);
    va_end(list);
    pthread_mutex_lock(&lock);
    struct device *d = ((request >> 8) & 255) == 'V' ? find(fd) : NULL;
    int error = d ? answer(d, (uint32_t)request, argument) : 0;
    pthread_mutex_unlock(&lock);
    if (!d) return NEXT(ioctl)(fd, request, argument);
    errno = error;
    return error ? -1 : 0;
}

static int backing(int fd) {
    pthread_mutex_lock(&lock);
    struct device *d = find(fd);
    pthread_mutex_unlock(&lock);
    return d ? d->memory_fd : fd;
}

void *mmap(void *address, size_t length, int protection, int flags, int fd, off_t offset) {
    return NEXT(mmap)(address, length, protection, flags, backing(fd), offset);
}

void *mmap64(void *address, size_t length, int protection, int flags, int fd, off_t offset) {
    return mmap(address, length, protection, flags, fd, offset);
}

int close(int fd) {
    pthread_mutex_lock(&lock);
    struct device *d = find(fd);
    if (d) {
        stop_streaming(d);
        for (int i = 0; i < MAX_OPEN; i++)
            if (devices[i] == d) devices[i] = NULL;
        unplug(d);
        NEXT(close)(d->memory_fd);
        free(d);
    }
    pthread_mutex_unlock(&lock);
    return NEXT(close)(fd);
}
