/* Sends the frames of a resistive array as UDP packets, and scans in which the read-out tests itself.
 *
 * C99 without allocation; the four functions of a board are yours. On an ESP32 (ESP-IDF or Arduino):
 *
 *     static const board mine = {drive_row, read_column, millis, send_udp};
 *     setup:       sender_scan(&mine, "hand");              once, with nobody touching
 *     loop:        sender_frame(&mine, "hand"); delay(100);
 *
 * A scan measures each crossing SENDER_REPEATS times at three levels of the drive: with its row let
 * go, at SENDER_LOW of the drive, and at the full drive. Gain and range of the converter are those at
 * which a cell at full scale reads half of SENDER_TOP at the low level. Its packets have one field
 * more, scan=LEVEL, and values from 0 to 1; what adaptfault makes of it: docs/firmware.md.
 */
#include <stdint.h>
#include <stdio.h>

#ifndef SENDER_ROWS
#define SENDER_ROWS 11
#define SENDER_COLS 10
#endif
#define SENDER_TOP 4095u   /* highest count of the converter */
#define SENDER_REPEATS 16
#define SENDER_LOW (1.0f / 64)
#define SENDER_LET_GO 0.0f /* the row is of high impedance */
#define SENDER_HELD (-1.0f) /* the row is held at ground, as all that are not read */
#define SENDER_SHARE 10000u /* a count is sent as a share of the range, with four digits */
#define SENDER_PACKET (64 + 6 * SENDER_ROWS * SENDER_COLS)

typedef struct {
    void (*drive)(int row, float level);             /* SENDER_HELD, SENDER_LET_GO, or up to 1 */
    uint16_t (*read)(int column, int is_scan);       /* counts; is_scan: the gain of a scan */
    uint32_t (*now)(void);                           /* milliseconds */
    void (*send)(const char *packet, int length);
} board;

void sender_frame(const board *of, const char *device);
void sender_scan(const board *of, const char *device);

static int share_of(uint16_t count, char *out)
{
    const uint32_t share = (count * SENDER_SHARE + SENDER_TOP / 2) / SENDER_TOP;
    if (share >= SENDER_SHARE) {
        return sprintf(out, ",1");
    }
    return sprintf(out, share ? ",.%04u" : ",0", (unsigned)share);
}

/* Reads all crossings and sends one packet; a level below 0: an ordinary frame. */
static void send_cells(const board *of, const char *device, float level)
{
    static char packet[SENDER_PACKET];
    const int is_scan = level >= 0;
    int length = snprintf(packet, 48, "%s,%lu", device, (unsigned long)of->now());
    if (is_scan) {
        length += sprintf(packet + length, ",scan=%.9g", (double)level);
    }
    for (int row = 0; row < SENDER_ROWS; row++) {
        of->drive(row, is_scan ? level : 1.0f);
        for (int column = 0; column < SENDER_COLS; column++) {
            const uint16_t count = of->read(column, is_scan);
            if (is_scan) {
                length += share_of(count, packet + length);
            } else {
                length += sprintf(packet + length, ",%u", (unsigned)count);
            }
        }
        of->drive(row, SENDER_HELD);
    }
    of->send(packet, length);
}

void sender_frame(const board *of, const char *device)
{
    send_cells(of, device, -1.0f);
}

void sender_scan(const board *of, const char *device)
{
    const float levels[] = {SENDER_LET_GO, SENDER_LOW, 1.0f};
    for (unsigned i = 0; i < sizeof levels / sizeof *levels; i++) {
        for (int repeat = 0; repeat < SENDER_REPEATS; repeat++) {
            send_cells(of, device, levels[i]);
        }
    }
}
